"""The services' health check: exit 0 when every URL answers, else 1 with the reason. The image carries no curl."""

import sys
import urllib.request

# Under the health check's own limit of 8 s, also with two addresses.
TIMEOUT_SECONDS = 3


def main() -> int:
    for url in sys.argv[1:]:
        try:
            urllib.request.urlopen(url, timeout=TIMEOUT_SECONDS).close()
        except OSError as error:
            print(f"{url}: {error}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
