"""``python -m workflows`` is the ``dsffnet`` command."""

from workflows.cli.main import main

if __name__ == "__main__":
    main()
