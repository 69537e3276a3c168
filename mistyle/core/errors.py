"""Exceptions for user-visible failures; each carries the exit code of the command line."""


class MistyleError(Exception):
    """A failure whose message names the input found, the input expected and the fix."""

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
    """The run stopped on request; rerun to resume after the last finished stage."""

    exit_code = 75
