"""What the MLflow mirror costs a training in the same process: steps a second with it and without, in turns.

    python -m benchmarks.training.mirror [--rounds 4] [--seconds 10] [--uri http://127.0.0.1:5000]

Beside the ratio, which a busy machine makes noise of, it prints the processor time of the mirror's thread: it holds the
interpreter's lock for no longer than that, so its share of the time bounds what the training can lose.
By default it mirrors into a SQLite store, which is the dearer case: the store's work is then done in this process too.
"""

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median

import torch

from training.networks import build_network
from training.tracking.journal import Journal
from training.tracking.mlflow_mirror import Mirror, publish
from training.tracking.record import Server, begin_record


class _Work:
    """Training steps of a narrow network on random meshes, with a journal line every few of them."""

    def __init__(self, run: Path) -> None:
        self.network = build_network("dsffnet", encoder_widths=(32, 64, 128), decoder_widths=(64, 128, 64))
        self.optimiser = torch.optim.AdamW(self.network.parameters())
        self.batch = torch.rand(3, 4, 1000, 3)
        self.journal, self.done = Journal(run / "metrics.jsonl"), 0

    def rate(self, seconds: float) -> float:
        """Steps a second over that long."""
        began, before = time.perf_counter(), self.done
        while time.perf_counter() - began < seconds:
            source, target, truth = self.batch
            loss = (self.network(source=source, target=target) - truth).square().mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            self.done += 1
            if self.done % 5 == 0:
                self.journal.write(self.done, {f"loss/{name}": loss.item() for name in range(12)})
        return (self.done - before) / (time.perf_counter() - began)


class _TimedMirror(Mirror):
    """A mirror that adds up the processor time of its publications."""

    used, publications = 0.0, 0

    def _publish(self) -> None:
        began = time.thread_time()
        super()._publish()
        self.used += time.thread_time() - began
        self.publications += 1


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=4)
    options.add_argument("--seconds", type=float, default=10.0)
    options.add_argument("--uri")
    given = options.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        run = Path(temporary) / "run"
        begin_record(run, name="mirror", kind="train", parent=None, parameters={})
        server = Server(given.uri or f"sqlite:///{temporary}/mlflow.db", artifacts=Path(temporary) / "artifacts")
        work = _Work(run)
        publish(run, server)  # tables are made, modules imported
        ratios, shares = [], []
        for number in range(given.rounds):
            without = work.rate(given.seconds)
            mirror, began = _TimedMirror(run, server), time.perf_counter()
            mirror.start()
            beside = work.rate(given.seconds)
            mirror.close()
            ratios.append(beside / without)
            shares.append(mirror.used / (time.perf_counter() - began))
            print(
                f"round {number}: {without:.1f} steps/s without, {beside:.1f} with the mirror: {ratios[-1]:.3f}; "
                f"{mirror.publications} publications, {1e3 * mirror.used / mirror.publications:.0f} ms of CPU each, "
                f"{shares[-1]:.1%} of the time"
            )
        print(f"median ratio {median(ratios):.3f}, median share of the time {median(shares):.1%}")


if __name__ == "__main__":
    main()
