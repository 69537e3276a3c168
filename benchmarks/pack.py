"""An offline studio in small: `mistyle pack`, installed and run with the network off and from a read-only place.

Linux only: `unshare` takes the network away, and a read-only bind mount makes the place unwritable (both as root, or in
a user namespace). Ends with exit code 1 where a step fails.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.common import arguments, finish, timed
from mistyle.core.paths import scenes

JOB = (
    "rig.resolution=128 surface.samples=5000 atlas.size=256 fit.refine=off report.frames=4 report.resolution=64".split()
)


def alone(line: list[str], folder: Path) -> None:
    """Run a command with a bare environment and no network; its last words where it fails."""
    root = [] if os.geteuid() == 0 else ["--map-root-user"]
    bare = {"HOME": str(folder), "PATH": os.environ["PATH"], "TMPDIR": str(folder)}
    done = subprocess.run(["unshare", *root, "--net", "--mount", *line], env=bare, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(line)[:200]}: exit {done.returncode}\n{done.stdout[-500:]}{done.stderr[-2000:]}")


def main() -> None:
    options = arguments((__doc__ or "").splitlines()[0])
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="mistyle-pack-") as name:
        folder = Path(name)
        packed, target = folder / "pack", folder / "installed"
        line = [sys.executable, "-m", "mistyle", "pack", "-o", str(packed)]
        timed(figures, "pack.seconds", lambda: subprocess.run(line, check=True))
        figures["pack.gb"] = sum(p.stat().st_size for p in packed.rglob("*") if p.is_file()) / 1e9
        timed(figures, "install.seconds", lambda: alone([str(packed / "install.sh"), str(target)], folder))
        settings = " ".join(f"--set {pair}" for pair in JOB)
        inputs = f"{scenes()}/demo.obj {scenes()}/demo_style.png"
        job = f"{target}/mistyle stylize {inputs} -o {folder}/out --preset draft {settings}"
        locked = (
            f"mount --bind {target} {target} && mount -o remount,ro,bind {target} && ! touch {target}/x 2>/dev/null"
        )
        timed(figures, "job.seconds", lambda: alone(["sh", "-c", f"{locked} && {job}"], folder))
        asset = folder / "out" / "asset" / "demo_demo_style.glb"
        if not asset.is_file():
            raise SystemExit(f"{asset}: the job ended without its asset")
    finish(figures, options.json)


if __name__ == "__main__":
    main()
