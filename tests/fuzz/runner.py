"""One case: a copy of a real thing, damaged as a number says, read under watch, and judged.

Allowed ends are success, where what was read is what was stored, and one line with status 1 or 2.
"""

import contextlib
import io
import os
import random
import re
import shutil
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from datagen.common.errors import DsffnetError
from tests.fuzz.mutators import mutate, reseal
from tests.fuzz.specimens import Specimens
from tests.fuzz.structures import SECRET, SECRET_NAME
from tests.fuzz.targets import FAMILIES, Target
from tests.fuzz.watch import CPU_SECONDS, MEMORY, OutOfTime, Trespass, Watch, snapshot, watched

_ROOT = Path(__file__).parents[2]
_PACKAGES = tuple(str(_ROOT / name) + os.sep for name in ("datagen", "dsffnet", "training", "workflows"))
_LONGEST_LINE = 2000
_ALLOCATION = re.compile(r"MemoryError|[Uu]nable to allocate|can.t allocate|Cannot allocate")


@dataclass(frozen=True)
class Finding:
    """Something that must not be: what, where in our packages, and the traceback where there is one."""

    what: str
    where: str = ""
    traceback: str = ""


@dataclass
class Verdict:
    """How a case ended; ``damage``: what was done to the tree; no ``findings``: as it must."""

    case: str
    target: str
    damage: list[str]
    end: str = ""
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)

    def __str__(self) -> str:
        lines = [f"--case {self.case!r} ({self.target}): {'; '.join(self.damage)}", f"  ended as: {self.end}"]
        return "\n".join(lines + [f"  {each.what}  [{each.where}]" for each in self.findings])


@dataclass
class Ended:
    """How a reading ended, and what it printed."""

    kind: str
    line: str = ""
    digest: str | None = None
    finding: Finding | None = None
    printed: str = ""


@dataclass(frozen=True)
class _Plan:
    """A case: which tree of which family is damaged, how (a number for each mutation), and who reads it."""

    name: str
    family: str
    tree: str
    target: Target
    mutations: tuple[str, ...]
    is_sealed: bool

    @classmethod
    def of(cls, family: str, seed: int, *, trees: list[str], quick: bool) -> "_Plan":
        name = f"{family}:{seed}"
        rng = random.Random(name)
        targets = [each for each in FAMILIES[family].targets if each.is_quick or not quick]
        mutations = tuple(f"{name}:{number}" for number in range(rng.choice((1, 1, 1, 2, 3))))
        return cls(name, family, rng.choice(trees), rng.choice(targets), mutations, rng.random() < 0.5)

    def smaller(self) -> "Iterator[_Plan]":
        """The same with one mutation less."""
        for left_out in self.mutations if len(self.mutations) > 1 else ():
            yield replace(self, mutations=tuple(each for each in self.mutations if each != left_out))


class Runner:
    """Runs cases over specimens, each in a folder of its own below ``home``."""

    def __init__(self, home: Path, specimens: Specimens) -> None:
        self._home, self._specimens = home, specimens
        self._known: dict[tuple[str, str, str], set[str]] = {}
        home.mkdir(parents=True, exist_ok=True)

    def run(self, family: str, seed: int, *, quick: bool = False) -> Verdict:
        """Run the case FAMILY:SEED; what fails is tried with fewer mutations. ``quick``: with cheap targets only."""
        folder = self._specimens.folder(FAMILIES[family].specimen)
        trees = sorted(str(path.relative_to(folder)) for path in folder.glob(FAMILIES[family].trees))
        plan = _Plan.of(family, seed, trees=trees, quick=quick)
        verdict = self._case(plan)
        while verdict.findings and (less := self._failing(plan.smaller(), verdict)):
            plan, verdict = less
        return verdict

    def _failing(self, plans: Iterable[_Plan], verdict: Verdict) -> tuple[_Plan, Verdict] | None:
        """The first of the plans that ends with the same finding."""
        for plan in plans:
            again = self._case(plan)
            if again.findings and again.findings[0].where == verdict.findings[0].where:
                return plan, again
        return None

    def _case(self, plan: _Plan) -> Verdict:
        stored = self._stored(plan)
        with self._arena(plan) as arena:
            canary, tree = _canary(arena.parent), arena / plan.tree
            named = FAMILIES[plan.family].named
            damage = [mutate(tree, random.Random(each), canary, named=named) for each in plan.mutations]
            if plan.is_sealed:
                reseal(tree)
                damage.append("hashes made to fit")
            before = snapshot(canary)
            with _surroundings(arena), watched(arena) as watch:
                ended = _ended(plan.target, tree)
            end = f"{ended.kind} {ended.line[:300]}".strip()
            verdict = Verdict(plan.name, plan.target.name, damage, end, watch.seconds)
            verdict.findings += _findings(ended, watch, set() if plan.is_sealed else stored)
            if snapshot(canary) != before:
                verdict.findings.append(Finding("the canary was changed"))
            if _holds_secret(arena, ended):
                verdict.findings.append(Finding("a secret is in what was written"))
        return verdict

    @contextlib.contextmanager
    def _arena(self, plan: _Plan) -> Iterator[Path]:
        """A folder with copies of the specimens of a case."""
        folder = Path(tempfile.mkdtemp(dir=self._home, prefix="case-"))
        try:
            for name in (FAMILIES[plan.family].specimen, *plan.target.needs):
                shutil.copytree(self._specimens.folder(name), folder / "arena", dirs_exist_ok=True)
            (folder / "arena" / "tmp").mkdir()
            yield folder / "arena"
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _stored(self, plan: _Plan) -> set[str]:
        """Digests of what may be read: of the undamaged tree, which must be read with success, and what it may fall to.

        This also imports what the target needs, so that cases are watched without that.
        """
        key = plan.family, plan.tree, plan.target.name
        if key not in self._known:
            with self._arena(plan) as arena, _surroundings(arena):
                tree = arena / plan.tree
                ends = [_ended(plan.target, each) for each in (tree, *sorted(tree.glob(plan.target.falls_to)))]
            assert {each.kind for each in ends} <= {"success", "status 0"}, f"{key}: undamaged, it ends as {ends[0]}"
            self._known[key] = {each.digest for each in ends if each.digest is not None}
        return self._known[key]


def _canary(folder: Path) -> Path:
    """A folder beside the case's, which must stay as it is and unread."""
    canary = folder / "canary"
    canary.mkdir()
    (canary / "secret.txt").write_text(SECRET)
    (canary / "tree").mkdir()
    (canary / "tree" / "secret.json").write_text(f'{{"secret": "{SECRET}"}}')
    return canary


@contextlib.contextmanager
def _surroundings(arena: Path) -> Iterator[None]:
    """The arena as current folder and folder of temporary files; a secret in the environment."""
    here, temporary = Path.cwd(), tempfile.tempdir
    os.environ[SECRET_NAME] = SECRET
    os.chdir(arena)
    tempfile.tempdir = str(arena / "tmp")
    try:
        yield
    finally:
        os.chdir(here)
        tempfile.tempdir = temporary
        del os.environ[SECRET_NAME]


def _ended(target: Target, tree: Path) -> Ended:
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        ended = _read(target, tree, error)
    ended.printed = out.getvalue() + error.getvalue()
    return ended


def _read(target: Target, tree: Path, error: io.StringIO) -> Ended:
    try:
        return Ended("success", digest=target.read(tree))
    except DsffnetError as raised:
        return Ended("error", str(raised))
    except SystemExit as raised:
        return _exit(raised.code, error.getvalue())
    except (Trespass, OutOfTime) as raised:
        return Ended("stopped", str(raised), finding=_raised(raised))
    except Exception as raised:
        return Ended(type(raised).__name__, str(raised), finding=_raised(raised))


def _exit(status: object, text: str) -> Ended:
    """The end of a command: by its status and what it wrote to standard error."""
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    ended = Ended(f"status {status}", "\n".join(lines))
    if status in (0, None):
        return ended
    if status not in (1, 2):
        ended.finding = Finding(f"status {status}", traceback=text)
    elif "Traceback" in text:
        ended.finding = Finding("a traceback is printed", traceback=text)
    elif len(lines) != 1 and not text.startswith("usage: "):
        ended.finding = Finding(f"{len(lines)} lines begin with error:", traceback=text)
    elif _line_fault(text):
        ended.finding = Finding(f"the line {_line_fault(text)}", traceback=text)
    return ended


def _line_fault(text: str) -> str:
    """What keeps standard error from being read in a terminal."""
    if any(len(line) > _LONGEST_LINE for line in text.splitlines()):
        return "is very long"
    if any(not character.isprintable() and character not in "\n\r\t" for character in text):
        return "holds control characters"
    return ""


def _raised(error: BaseException) -> Finding:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(_PACKAGES)]
    where = f"{Path(ours[-1].filename).relative_to(_ROOT)}:{ours[-1].lineno} {ours[-1].name}" if ours else ""
    kind = type(error).__name__ if isinstance(error, Exception) else str(error).split("/")[0]
    return Finding(f"{kind}: {_start(error)}", where, "".join(traceback.format_exception(error))[-6000:])


def _start(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0][:150]


def _findings(ended: Ended, watch: Watch, stored: set[str]) -> Iterator[Finding]:
    if ended.finding:
        yield ended.finding
    else:
        yield from (Finding(fault) for fault in watch.faults)
    if watch.bytes > MEMORY:
        yield Finding(f"memory rose by {watch.bytes / 2**20:,.0f} MB")
    if watch.seconds > CPU_SECONDS:
        yield Finding(f"it took {watch.seconds:.0f} s")
    if _ALLOCATION.search(ended.line):
        yield Finding(f"memory was the only bound: {ended.line[:200]}")
    if stored and ended.digest is not None and ended.digest not in stored:
        yield Finding("what was read is not what was stored", where="digest")


def _holds_secret(arena: Path, ended: Ended) -> bool:
    if SECRET in ended.printed or SECRET in ended.line:
        return True
    files = (path for path in arena.rglob("*") if path.is_file() and not path.is_symlink())
    return any(path.stat().st_size < 2**24 and SECRET.encode() in path.read_bytes() for path in files)
