"""A billion meshes on paper: the scheduler of generation simulated with measured service times, on 1 to 1,000 nodes.

    python -m benchmarks.datagen.scale [scale.png]      # the tables and the picture of docs/scale.md

One driver hands out tasks (`datagen.generate.ray_runner`: three a CPU in flight), each of a shard or, where shards are
small, of as many as take half a second; a CPU makes them, and holds them until they are stored, through the network of
its node and the object store that all share. Whoever is busy all the time is the bottleneck.
"""

import heapq
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from matplotlib.figure import Figure

from datagen.generate.shards import TASK_SECONDS
from training.viz.style import DPI, INK, PAGE, QUIET, logarithmic, method_colors, saved, style_axes

MESHES = 1_000_000_000
NODES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ROUNDS = 4  # tasks a CPU that are simulated
_IN_FLIGHT = 3


@dataclass(frozen=True)
class Work:
    """What one task takes, in seconds of each of those that it passes.

    ``driver`` and ``finish`` (the manifest's part, after the last task) are of one process; ``make`` of a CPU of a
    node; ``send`` of a node's network; ``store`` of the object store that all nodes share.
    """

    meshes: int
    driver: float
    make: float
    send: float
    store: float
    finish: float = 0.0

    @property
    def alone(self) -> float:
        """Seconds from its being made to its being stored, where nobody else is."""
        return self.make + self.send + self.store


@dataclass(frozen=True)
class Outcome:
    """Seconds that some tasks took, and the share of it that each was busy."""

    seconds: float
    busy: dict[str, float]

    @property
    def bottleneck(self) -> str:
        return max(self.busy, key=lambda name: self.busy[name])


def simulate(work: Work, tasks: int, *, nodes: int, cpus: int = 16) -> Outcome:
    """Do tasks: first come, first served by the driver, then a CPU, its node's network, the store."""
    events: list[tuple[float, int, str, int]] = []
    idle, network = [node for _ in range(cpus) for node in range(nodes)], [0.0] * nodes
    driver = store = now = 0.0
    to_do, in_flight, waiting, number = tasks, 0, 0, count()

    def at(moment: float, what: str, node: int) -> None:
        heapq.heappush(events, (moment, next(number), what, node))

    while to_do or events:
        while to_do and in_flight < max(4, _IN_FLIGHT * nodes * cpus):
            driver = max(driver, now) + work.driver
            at(driver, "handed out", -1)
            to_do, in_flight = to_do - 1, in_flight + 1
        now, _, what, node = heapq.heappop(events)
        if what == "made":
            network[node] = max(network[node], now) + work.send
            at(network[node], "sent", node)
        elif what == "sent":
            store = max(store, now) + work.store
            at(store, "stored", node)
        else:
            if what == "stored":
                in_flight -= 1
                idle.append(node)
            else:
                waiting += 1
            if waiting and idle:
                waiting -= 1
                at(now + work.make, "made", idle.pop())
    totals = {
        "driver": tasks * work.driver,
        "CPUs": tasks * work.make / (nodes * cpus),
        "network": tasks * work.send / nodes,
        "object store": tasks * work.store,
    }
    return Outcome(now + tasks * work.finish, {name: total / now for name, total in totals.items()})


# Measured (docs/scale.md): meshes/s of whole shards on one core and bytes a mesh (benchmarks.datagen.generation);
# DRIVER for a task and FINISH for a shard (benchmarks.datagen.driver).
DRIVER, FINISH = 0.495e-3, 0.036e-3
# Assumed: a node of 16 CPUs with 12.5 Gbit/s; 3,500 objects written a second below one prefix, whatever their size.
CPUS, NETWORK, PUTS = 16, 12.5e9 / 8, 3500
# Assumed prices in dollars: an hour of a node, a terabyte kept for a month, a million objects written.
NODE_HOUR, TERABYTE_MONTH, MILLION_PUTS = 0.70, 23.0, 5.0


@dataclass(frozen=True)
class Body:
    """Meshes that one core makes in a second, bytes of one on the disk, and how many a shard holds."""

    rate: float
    size: float
    shard: int

    @property
    def work(self) -> Work:
        shards = max(1, int(TASK_SECONDS * self.rate / self.shard))
        meshes = shards * self.shard
        send = meshes * self.size / NETWORK
        return Work(meshes, DRIVER, meshes / self.rate, send, shards / PUTS, finish=shards * FINISH)

    @property
    def bill(self) -> str:
        shards, terabytes, cpu_hours = MESHES / self.shard, MESHES * self.size / 1e12, MESHES / self.rate / 3600
        node_hours = max(cpu_hours / CPUS, MESHES * self.size / NETWORK / 3600)
        return (
            f"{shards:,.0f} shards, {terabytes:,.1f} TB, {cpu_hours:.0f} CPU hours, {node_hours:.1f} node hours "
            f"(${node_hours * NODE_HOUR:.0f}), written ${shards / 1e6 * MILLION_PUTS:.1f}, kept "
            f"${terabytes * TERABYTE_MONTH:,.0f} a month"
        )


BODIES = {
    "615 vertices, 100 a shard": Body(18_500, 6600, 100),
    "615 vertices, 4,000 a shard": Body(18_500, 6600, 4000),
    "13,718 vertices, 100 a shard": Body(3040, 132_500, 100),
    "13,718 vertices, 400 a shard": Body(3040, 132_500, 400),
}


def hours(work: Work, nodes: int) -> tuple[float, str]:
    """Hours of a billion meshes at the pace of the steady state, which the later of two halves has; the bottleneck."""
    tasks = _ROUNDS * nodes * CPUS
    half, whole = (simulate(work, count, nodes=nodes, cpus=CPUS) for count in (tasks // 2, tasks))
    return MESHES / work.meshes * (whole.seconds - half.seconds) / (tasks / 2) / 3600, whole.bottleneck


def draw(results: dict[str, Sequence[tuple[float, str]]], path: Path) -> None:
    """Meshes a second over nodes, a line a body, a mark by what is the bottleneck."""
    marks = {"CPUs": "o", "network": "s", "driver": "D", "object store": "^"}
    figure = Figure(figsize=(6.4, 3.6), dpi=DPI, facecolor=PAGE, layout="constrained")
    axes = figure.subplots()
    lines = zip(results.items(), method_colors(list(results)).values(), (7, 6, 5, 4), strict=True)
    for (name, found), color, size in lines:
        rates = [MESHES / hours / 3600 for hours, _ in found]
        axes.plot(NODES, rates, color=color, linewidth=1.2, label=name)
        for nodes, rate, (_, bottleneck) in zip(NODES, rates, found, strict=True):
            axes.plot(nodes, rate, marks[bottleneck], color=color, markersize=size)
    for mark in sorted({bottleneck for found in results.values() for _, bottleneck in found}):
        axes.plot([], [], marks[mark], color=QUIET, markersize=5, label=f"bound by: {mark}")
    style_axes(axes)
    axes.set_xscale("log")
    axes.set_yscale("log")
    logarithmic(axes.xaxis, (1, 2, 5))
    axes.legend(fontsize=7, labelcolor=INK, frameon=False, loc="lower right", ncols=2)
    axes.set_xlabel("nodes of 16 CPUs", fontsize=7.5, color=INK)
    axes.set_ylabel("meshes a second", fontsize=7.5, color=INK)
    saved(figure, path)


def main(words: Sequence[str]) -> None:
    results = {name: [hours(body.work, nodes) for nodes in NODES] for name, body in BODIES.items()}
    for name, found in results.items():
        print(f"{name}: {BODIES[name].bill}")
        for nodes, (taken, bottleneck) in zip(NODES, found, strict=True):
            print(f"  {nodes:5,} nodes {taken:9.2f} h, bound by the {bottleneck}")
    if words:
        draw(results, Path(words[0]))


if __name__ == "__main__":
    main(sys.argv[1:])
