"""``dsffnet demo``: a page in the browser on which meshes are posed like each other."""

import argparse
import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from workflows.cli.declare import Command, Parser, add_checkpoint_option
from workflows.cli.transfer import add_model_option, weights_of
from workflows.cli.ui import require_free
from workflows.pipeline.console import print_text


def demo_command(options: argparse.Namespace) -> None:
    """Show a page in the browser: pick a source and a target, people, animals or your own meshes, and look.

    examples:
      dsffnet demo
      dsffnet demo --model runs/quickstart --port 8001
    """
    require_free(options.host, options.port, another="dsffnet demo --port {0}")
    with weights_of(options) as weights:
        with saying_what_it_does() as say:
            say("loading the libraries")
            from workflows.demo.server import DemoServer
            from workflows.demo.transfers import Transfers

            transfers = Transfers(weights)
            transfers.warm_up(say)
        server = DemoServer(transfers, host=options.host, port=options.port)
        print_text(f"http://{options.host}:{server.port}   (Ctrl-C ends it)")
        with contextlib.closing(server):
            _until_interrupted()


@contextlib.contextmanager
def saying_what_it_does(seconds: float = 5.0) -> Iterator[Callable[[str], None]]:
    """Print what is being done, and every so many seconds that it still is."""
    done, doing, began = threading.Event(), [""], time.monotonic()

    def repeat() -> None:
        while not done.wait(seconds):
            print_text(f"still {doing[0]}: {time.monotonic() - began:.0f} s since the start")

    def say(what: str) -> None:
        doing[0] = what
        print_text(f"{what} ...")

    teller = threading.Thread(target=repeat, daemon=True)
    teller.start()
    try:
        yield say
    finally:
        done.set()
        teller.join()


def _until_interrupted() -> None:
    try:
        threading.Event().wait()
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("the page is closed, and what was uploaded is removed") from interrupt


def _demo_options(made: Parser) -> None:
    add_model_option(made)
    add_checkpoint_option(made)
    made.add_argument("--tracking-uri", metavar="URI", help="MLflow server of models:/ (default: MLFLOW_TRACKING_URI)")
    made.add_argument(
        "--host", default="127.0.0.1", help="address to listen at; anyone who reaches it may use it (%(default)s)"
    )
    made.add_argument("--port", type=int, default=8080, help="where to listen (default: %(default)s)")
    made.set_defaults(force=False)


COMMAND = Command(demo_command, _demo_options)
