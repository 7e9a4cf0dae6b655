"""Everything that a user can fix: one class and one exit code each.

A message names the file, the element or vertex, the number found, and the next step.
"""


class Fab4dError(Exception):
    """Base of the errors that end a command with a message instead of a trace."""

    exit_code = 1


class DesignRejectedError(Fab4dError):
    """The best design found misses the goal or an acceptance check; its files are kept, marked REJECTED."""

    exit_code = 2


class SceneError(Fab4dError):
    """A scene or card has an unknown key, a missing key or a value out of range."""

    exit_code = 3


class MeshError(Fab4dError):
    """A mesh file is unreadable, or the pair of shapes is not usable."""

    exit_code = 4


class MaterialError(Fab4dError):
    """A material card describes no elastic solid."""

    exit_code = 5


class EquilibriumError(Fab4dError):
    """No equilibrium was found for given loads or held positions."""

    exit_code = 6


class BodyError(Fab4dError):
    """The bodies are not watertight, manifold, conforming, or do not add up."""

    exit_code = 7


class ArtifactError(Fab4dError):
    """A file of the run folder is missing, damaged, or was made by something else."""

    exit_code = 8


class MissingToolError(Fab4dError):
    """An optional program or package that a command needs is not installed."""

    exit_code = 9


class SliceError(Fab4dError):
    """A slicer fails on the bodies, leaves a tool unused, or lays down another volume than theirs."""

    exit_code = 10


class InterruptedRunError(Fab4dError):
    """The run was stopped by the user; what was finished is kept."""

    exit_code = 130
