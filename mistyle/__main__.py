"""`python3 -m mistyle`, also from a bare Python. Older Pythons have to be able to read this file."""

import os
import shutil
import subprocess
import sys

NEW_ENOUGH = "import sys; sys.exit(not (3, 11) <= sys.version_info[:2])"


def main():
    """Start with a Python that is new enough, set up what is missing, then run the verb; ends with its exit code."""
    if sys.version_info < (3, 11):
        names = ("python3.13", "python3.12", "python3.11", "python3.14")
        # A name on the PATH need not run: pyenv puts a script there for each version that it knows of.
        there = [path for path in map(shutil.which, names) if path]
        newer = next((path for path in there if subprocess.call([path, "-c", NEW_ENOUGH]) == 0), None)
        if not newer:
            found = "%d.%d" % sys.version_info[:2]
            sys.stderr.write("mistyle: this is Python %s; 3.11 or newer is needed. Install one and use it.\n" % found)
            sys.exit(4)
        os.execv(newer, [newer, "-m", "mistyle"] + sys.argv[1:])
    from mistyle.setup.bootstrap import start

    sys.exit(start(sys.argv[1:], command_line, doctor))


def command_line(arguments):
    """Run a verb and return its exit code."""
    from mistyle.process.children import end_with_asker

    # Before the imports, which take seconds on a busy machine: a shard whose batch is gone must not linger in them.
    end_with_asker()
    try:
        from mistyle.cli.main import main as run
    except KeyboardInterrupt:
        return 130
    return run(arguments)


def doctor(json):
    """Print what this machine has and what is missing, without installed packages too; returns the exit code."""
    from mistyle.cli.doctor import main as report

    return report(json)


if __name__ == "__main__":
    main()
