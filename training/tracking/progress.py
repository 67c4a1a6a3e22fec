"""What a person reads while a network trains, made of journal rows alone, so that every launcher says the same."""

import math
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any

from training.objectives import PMD_UNIT

_INTERVALS = 50  # between journal rows, that the recent rate is taken from
_RESTART_SECONDS, _RESTART_FACTOR = 30.0, 10.0  # a pause as long is a restart, and says nothing of the rate
_LEFT_OUT_FIRST = ("meshes", "best", "epoch", "wait", "loss", "pmd")


def duration(seconds: float) -> str:
    """A time in its two largest units: 45 s, 3 min 20 s, 2 h 5 min, 1 d 4 h."""
    whole = round(seconds)
    for size, unit, part, smaller in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            rest = whole % size // part
            return f"{whole // size} {unit}" + (f" {rest} {smaller}" if rest else "")
    return f"{whole} s"


class Progress:
    """Takes a journal's rows as they come, and says where the training is and how long it will still take.

    ``steps``, ``steps_per_epoch``: where the training ends, and how long an epoch is, where it is known.
    """

    def __init__(self, *, steps: int, steps_per_epoch: int | None = None) -> None:
        self._steps, self._steps_per_epoch = steps, steps_per_epoch
        self._best: float | None = None
        self._latest: dict[str, Any] = {}
        self._before: Mapping[str, Any] | None = None
        self._intervals: deque[tuple[float, int, bool]] = deque(maxlen=_INTERVALS)

    @property
    def step(self) -> int | None:
        """The latest step; None before the first row."""
        return self._latest.get("step")

    def add(self, row: Mapping[str, Any], *, past: bool = False) -> None:
        """Take a row; ``past``: of an earlier session, whose pace and pauses say nothing of this one's."""
        self._latest |= row
        pmd = row.get("evaluation/pmd_unseen")
        if pmd is not None and not math.isnan(pmd):
            self._best = pmd if self._best is None else min(self._best, pmd)
        if past:
            return
        if self._before is not None and row["step"] > self._before["step"]:
            seconds, evaluated = row["time"] - self._before["time"], any(key.startswith("evaluation/") for key in row)
            if seconds >= 0:  # else the clock was put back meanwhile
                self._intervals.append((seconds, row["step"] - self._before["step"], evaluated))
        self._before = row

    def seconds_left(self) -> float | None:
        """Time to the last step at the recent rate, evaluations and checkpoints included; None while it is unknown."""
        if self.step is None or not self._intervals:
            return None
        longest = max(_RESTART_SECONDS, _RESTART_FACTOR * median(seconds for seconds, _, _ in self._intervals))
        usual = [(seconds, steps) for seconds, steps, evaluated in self._intervals if evaluated or seconds <= longest]
        done = sum(steps for _, steps in usual)
        return sum(seconds for seconds, _ in usual) / done * (self._steps - self.step) if done else None

    def line(self, width: int | None = None) -> str:
        """One line about a training: epoch, step, loss, PMD, meshes a second, input wait if it matters, time left.

        It is made of the latest of each value; what is missing is left out, so that it is empty before the first row.
        The best PMD is said where it is better than the latest. ``width``: characters there is room for; the least
        important parts are left out until it fits.

        >>> progress = Progress(steps=100, steps_per_epoch=40)
        >>> progress.add({"step": 20, "loss/total": 0.5})
        >>> progress.line()
        'epoch 1/3, step 20/100, loss 0.5'
        """
        if self.step is None:
            return ""
        row, steps, steps_per_epoch, best = self._latest, self._steps, self._steps_per_epoch, self._best
        step, seconds_left = int(self.step), self.seconds_left()
        epoch = min(max(step - 1, 0), max(steps - 1, 0)) // steps_per_epoch + 1 if steps_per_epoch else 0
        pmd, wait = row.get("evaluation/pmd_unseen"), row.get("input_wait", 0.0)
        parts = {
            "epoch": f"epoch {epoch}/{math.ceil(steps / steps_per_epoch)}" if steps_per_epoch else "",
            "step": f"step {step:,}/{steps:,}",
            "loss": _said("loss {:.4g}", row.get("loss/total")),
            "pmd": _said("PMD unseen {:.1f}e-4", None if pmd is None else pmd / PMD_UNIT),
            "plane": _said("{:.1f} mm to the plane", row.get("evaluation/plane_unseen")),
            "iou": _said("IoU {:.2f}", row.get("evaluation/iou_unseen")),
            "best": f"best {best / PMD_UNIT:.1f}e-4" if pmd is not None and best is not None and best < pmd else "",
            "meshes": _said("{:,.0f} meshes/s", row.get("meshes_per_second")),
            "wait": f"input wait {wait:.0%}" if wait > 0.02 else "",
            "left": f"{duration(seconds_left)} left" if seconds_left is not None and step < steps else "",
        }
        return _fitted({name: words for name, words in parts.items() if words}, width)


def _said(words: str, value: float | None) -> str:
    return "" if value is None else words.format(value)


def _fitted(parts: dict[str, str], width: int | None) -> str:
    for name in _LEFT_OUT_FIRST:
        if width is None or len(", ".join(parts.values())) <= width:
            break
        parts.pop(name, None)
    return ", ".join(parts.values())
