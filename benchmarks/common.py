"""What the benchmarks share: clocks, the peak of memory, the machine, and the table and JSON they end with."""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from mistyle.process.cores import cores

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MISTYLE_DATA") or ROOT.parent / "shared" / "data")  # real meshes, pictures and weights
PROGRAM = "import sys; from mistyle.cli.main import main; sys.exit(main())"  # `python -c` of it is the command line


def arguments(description: str, argv: list[str] | None = None) -> argparse.Namespace:
    """The options that every benchmark has: --quick and --json FILE."""
    return parser(description).parse_args(argv)


def parser(description: str) -> argparse.ArgumentParser:
    """A parser of the options that every benchmark has, for benchmarks that have more."""
    options = argparse.ArgumentParser(prog=program(), description=description)
    options.add_argument("--quick", action="store_true", help="small sizes, only to see that it works")
    options.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the figures as JSON ('-': to stdout only)"
    )
    return options


def program() -> str:
    """The command of the benchmark that runs, for its usage."""
    spec = sys.modules["__main__"].__spec__
    return f"python -m {spec.name.removesuffix('.__main__')}" if spec is not None else Path(sys.argv[0]).name


def timed(figures: dict[str, float], name: str, work: Callable[[], T]) -> T:
    """Do the work; note its wall time as `name` and its processor time (all threads) as `name`.cpu."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    figures[name] = time.perf_counter() - wall
    figures[f"{name}.cpu"] = time.process_time() - cpu
    return result


def run_mistyle(*words: Any) -> Any:
    """The JSON that `mistyle WORDS --json` prints, {} where it prints none; SystemExit where it fails."""
    command = [sys.executable, "-c", PROGRAM, *map(str, words), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=os.environ)
    if done.returncode != 0:
        raise SystemExit(f"mistyle {' '.join(map(str, words))} ended with {done.returncode}")
    return json.loads(done.stdout) if done.stdout.strip().startswith("{") else {}


def peak_gb() -> float:
    """The most memory this process has held so far, in GB (10^9 bytes); 0 on Windows, where nothing tells."""
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e9


def machine() -> dict[str, Any]:
    """Where the figures were measured; `load` above `cores` means that others were working too."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": cores(),
        "load": round(load, 1),
        "python": platform.python_version(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def lettered(text: str, size: tuple[int, int]) -> Any:
    """A strip of a picture, (rows, columns) float64 0..1, with a line of text as high as it."""
    # Here, so that benchmarks of memory and time do not load them with the clocks.
    import cv2
    import numpy as np

    height = size[0]
    strip, place = np.zeros(size, np.uint8), (height // 4, height - height // 4)
    cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, height / 42.5, 255, max(1, height // 17), cv2.LINE_AA)
    return strip / 255


def finish(figures: Mapping[str, float], json_file: Path | None) -> None:
    """Print the table; write {"figures": …, "machine": …} where asked."""
    result = {"figures": {k: round(float(v), 6) for k, v in figures.items()}, "machine": machine()}
    text = json.dumps(result, indent=2, allow_nan=False) + "\n"
    if str(json_file) == "-":
        print(text, end="")
        return
    width = max(len(name) for name in figures)
    for name, value in figures.items():
        print(f"{name:<{width}}  {value:12.4f}")
    print(", ".join(f"{k} {v}" for k, v in result["machine"].items()))
    if json_file is not None:
        json_file.write_text(text, encoding="utf-8")
