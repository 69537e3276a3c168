"""Exit codes of commands; every expected error becomes one sentence on stderr."""

import argparse
import json
import sys
from collections.abc import Callable

from mistyle.core.errors import MistyleError
from mistyle.process import stopping

Command = Callable[[argparse.Namespace], int]


def run(command: Command, options: argparse.Namespace) -> int:
    """Run a command with signal handling; returns the exit code. Only a bug of mistyle itself shows a traceback."""
    with stopping.listening():
        try:
            return command(options)
        except MistyleError as error:
            return _failed(options, error)
        except KeyboardInterrupt:
            print("mistyle: interrupted; rerun to resume", file=sys.stderr)
            return 130
        except BrokenPipeError:
            return 1
        except OSError as error:
            from mistyle.process.disk_errors import unexpected

            sentence = unexpected(error)
            if sentence is None:
                raise
            return _failed(options, sentence)


def _failed(options: argparse.Namespace, error: MistyleError) -> int:
    if getattr(options, "json", False):
        print(json.dumps({"error": str(error), "exit_code": error.exit_code}))
    print(f"mistyle: {error}", file=sys.stderr)
    return error.exit_code
