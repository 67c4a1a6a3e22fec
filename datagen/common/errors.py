"""One error hierarchy for everything a person can get wrong or a disk can break.

Every message says what is wrong, where, the offending value, and the next command. The command line
prints it as one line and exits with ``exit_status``; nothing else of the traceback is shown.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class DsffnetError(Exception):
    """Base of all errors that are a person's business rather than a programmer's."""

    exit_status = 1


class DsffnetWarning(UserWarning):
    """What a result may be poor for, where Python calls; a command prints it on standard error."""


class RecipeError(DsffnetError):
    """A recipe or a command line that cannot mean anything (unknown key, wrong type, impossible value)."""

    exit_status = 2


class MeshError(DsffnetError):
    """A mesh file or mesh array that cannot be used (missing, unreadable, empty, not finite, no faces)."""


class NotOneBodyError(MeshError):
    """A file of several geometries that do not make one body, so that some must be chosen."""


class BodyError(DsffnetError):
    """A body model that cannot be loaded, or that produced something that is not a mesh."""


class DatasetError(DsffnetError):
    """A dataset that is missing, incomplete, damaged, of another version, or made by another recipe."""


class ClusterError(DsffnetError):
    """The Ray cluster cannot be reached, has no room, or gave up on a task."""


class StorageError(DsffnetError):
    """Files could not be written (full disk, no permission); what was there before is untouched."""


class UnsafeFileError(DsffnetError):
    """A file named by a dataset, run or mesh that leads out of its folder, is no regular file, or is far too long."""


class DamagedFileError(DsffnetError):
    """A file that does not hold what is written to such a file (empty, cut short, garbage, of other types)."""


class OutOfMemory(DsffnetError):
    """Memory ran out, of the machine or of a GPU; what was complete is untouched."""


def reason_of(error: BaseException) -> str:
    """Return what an exception says in one short line: the operating system's words, or its own."""
    words = str(getattr(error, "strerror", None) or error)
    line = " ".join(words.split()) or type(error).__name__
    return line if len(line) <= 200 else f"{line[:200]}..."


def first_line_of(error: BaseException) -> str:
    """Return the first line of what an exception says, cut where it is long; its type where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


@contextmanager
def storage_errors(place: object, *, advice: str = "", also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Raise StorageError, with ``advice`` on what to do, for an OSError (or ``also``) while ``place`` is written.

    Raises
    ------
    StorageError
        The disk is full, the place cannot be written to, a device is out of order.
    """
    expected: tuple[type[Exception], ...] = (OSError, *also)
    try:
        yield
    except expected as error:
        raise StorageError(f"could not write {place}: {reason_of(error)}. {advice}".removesuffix(". ")) from error


class ShardDamage(ValueError):
    """The bytes of a shard are not what was written."""


class ShardMismatch(ValueError):
    """Meshes are not those that a shard is to hold: of other vertices, more or fewer."""


class NoDataset(DatasetError):
    """There is nothing at that place."""


class EvaluationError(DsffnetError):
    """Methods and data that cannot be measured together."""


class CompilerError(DsffnetError):
    """torch.compile was asked for on a machine that lacks what it builds kernels with."""


class ReportError(DsffnetError):
    """A report that asks for something that is not there."""


class RegistryError(DsffnetError):
    """A registered model that MLflow does not know or cannot hand out."""


class CheckpointError(DsffnetError):
    """A run without a usable checkpoint, a damaged one, or one that does not belong to what is asked."""


class TrainingError(DsffnetError):
    """Training cannot continue: non-finite loss, too few CPUs, another process on the same run.

    ``secondary`` marks what a rank says only because another rank failed.
    """

    def __init__(self, message: str, *, secondary: bool = False) -> None:
        super().__init__(message)
        self.secondary = secondary


class TrainingStopped(TrainingError):
    """Told to stop before the last step; a checkpoint was written. Its exit status is that of a program so ended."""

    exit_status = 143


class BudgetSpent(TrainingStopped):
    """The time that one command may take is used up; a checkpoint was written. 75 asks a script to try again."""

    exit_status = 75


class TrackingError(DsffnetError):
    """The tracking server cannot be reached, or refuses; nothing is lost, it can be sent later."""


class WorkflowError(DsffnetError):
    """A workflow that cannot run as asked."""
