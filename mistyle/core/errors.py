"""One exception type per kind of trouble a user can meet; each carries the exit code of the command line."""


class MistyleError(Exception):
    """Something went wrong that the message explains: what came, what was expected, what to do."""

    exit_code = 1


class UsageError(MistyleError):
    """A command or a setting is wrong."""

    exit_code = 2


class InputRefused(MistyleError):
    """A mesh, an image or another input file cannot be used."""

    exit_code = 3


class EnvironmentMissing(MistyleError):
    """LLVM, a GPU, weights or an optional package is missing."""

    exit_code = 4


class Stopped(MistyleError):
    """The run was asked to stop; running the same command again goes on from the last finished stage."""

    exit_code = 75
