"""How well materials are recovered from pictures, beside the usual ways, on the same pictures and in the same time.

    python -m benchmarks.material_recovery --out FOLDER [--json FILE] [--assets avocado suzanne ...] [--mesh FILE.glb]

Every object stands twice: with its own maps, and ("_strong") with synthetic ones that no constant comes near. What is
rendered, at which resolution and with which texels: `truth.py`, `pictures.py`. Fitted from grey, with
metallic unknown; 16 evenly spread views x 3 camera-fixed lights one at a time, ("_paper") the paper's own rig with its
lights together, ("_soft", no rivals) 16 views x an environment map in 3 positions, ("own_soft", printed as NAME_soft)
the same with the object's own maps, and ("_unknown", no rivals) 16 views under one that stands still and is solved for
too. Texel figures are over the surface that at least three cameras see, weighted by area; "confident_" ones over the
95 % of it that the fit trusts most; "within_" ones are the share of it whose error is within the fit's own standard
deviation. Relit: four lights of no reference, cameras between theirs, mean over the pictures.

`figures` are ours. `baselines`: "constant" is the best map of one value; "other_seed" is the truth, relit with other
random numbers than all others share: what two noisy renders of equal maps differ by; "together" is ours from the same
pictures summed by view (all lights on); "naive", "naive_pyramid", "naive_prb" and "naive_prb_pyramid" are
`naive_fit.py` with `direct` or `prb`, for as many seconds as ours took; their "_converged" forms go on until the loss
settles, at most ten times as long (`--rivals` names them; "together", "naive" and "naive_pyramid" run without it).
`gain_over_naive_db` is relight_psnr_l minus that of the naive loop.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

import numpy as np

from benchmarks.common import DATA, program
from benchmarks.material_recovery import pictures as drawing
from benchmarks.material_recovery import report
from benchmarks.material_recovery.metrics import (
    best_constant,
    calibration,
    confident,
    map_errors,
    mean_errors,
    relight_errors,
)
from benchmarks.material_recovery.ours import ours
from benchmarks.material_recovery.pictures import Shot
from benchmarks.material_recovery.rivals import LOOPS, naive, write_job
from benchmarks.material_recovery.truth import (
    ASSETS,
    LEAST_VIEWS,
    UV,
    Truth,
    find_asset,
    observed_areas,
    seen,
    truth,
)
from mistyle.core.errors import MistyleError, UsageError
from mistyle.core.maps import Maps
from mistyle.render.mitsuba.scene import Frame

RELIT_SPP = 128  # least samples of relit pictures: their own noise counts as an error of the maps
KINDS = ("real", "strong", "paper", "soft", "own_soft", "unknown")
RIVALS = ("together", *LOOPS)
USUAL = ("together", "naive", "naive_pyramid")


@dataclass(frozen=True)
class Row:
    """One line of the table to make: an object and what is asked of it, one of KINDS."""

    name: str
    file: Path
    uv: UV
    kind: str

    @property
    def strong(self) -> bool:
        """Whether its maps are the synthetic ones."""
        return self.kind not in ("real", "own_soft")

    @property
    def soft(self) -> bool:
        """Whether an environment lights it, which no rival can take."""
        return self.kind in ("soft", "own_soft", "unknown")


def main(argv: list[str] | None = None) -> None:
    options = parse(argv)
    if options.stanford_orb or options.tensoir:
        published(options)
        return
    figures: dict[str, float] = {}
    baselines: dict[str, float] = {}
    notes: list[str] = []
    for row in rows(options):
        methods, said = measure(row, options)
        name = label(row)
        for method, values in methods.items():
            target = figures if method == "ours" else baselines
            prefix = name if method == "ours" else f"{name}.{method}"
            target.update({f"{prefix}.{key}": value for key, value in values.items()})
        quiet = str(options.json) == "-"
        notes.extend(f"{name}: {line}" for line in said)
        if not quiet:
            print(report.table(name, methods))
            print("\n".join(f"  {line}" for line in said))
            if row.kind in ("real", "strong") and not options.quick:
                print("\n".join(report.verdicts(methods, row.strong)))
            print(flush=True)
        # After every row, so that a run that is stopped leaves what it had.
        if not quiet:
            report.write(figures, baselines, notes, options.json)
    if str(options.json) == "-":
        report.write(figures, baselines, notes, options.json)


def published(options: argparse.Namespace) -> None:
    """The rows of a published data set alone."""
    from benchmarks.material_recovery import datasets as sets

    if options.stanford_orb:
        figures = sets.stanford_orb(options.stanford_orb, frame=options.frame, spp=options.spp)
    elif options.mesh and options.environments:
        figures = sets.tensoir(
            options.tensoir, options.mesh, options.environments, frame=options.frame, spp=options.spp
        )
    else:
        raise UsageError("--tensoir needs --mesh FILE (the scene's mesh) and --environments FOLDER (its .hdr maps).")
    if str(options.json) != "-":
        for name, value in figures.items():
            print(f"{name:<60} {value:8.2f}")
    report.write(figures, {}, [], options.json)


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog=program(), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one object, small pictures: a minute or two")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON ('-': to stdout only)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="pictures side by side, by row")
    parser.add_argument("--cache", type=Path, default=Path(gettempdir(), "mistyle_recovery"), help="rendered pictures")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real data (MISTYLE_DATA)")
    parser.add_argument("--assets", nargs="+", choices=list(ASSETS), default=None)
    parser.add_argument("--maps", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--mesh", type=Path, metavar="FILE", help="any textured glTF instead of the assets")
    parser.add_argument("--uv", choices=["own", "new"], default="own", help="the file's UVs where usable, or ours")
    parser.add_argument("--frame", choices=["mikkt", "mitsuba"], default="mikkt", help="frame of the normal maps")
    parser.add_argument("--resolution", type=int, default=None)
    parser.add_argument("--views", type=int, default=None)
    parser.add_argument("--spp", type=int, default=None, help="samples of the references")
    parser.add_argument(
        "--direct", action="store_true", help="references without light between surfaces, to see what that costs"
    )
    parser.add_argument("--stanford-orb", type=Path, metavar="FOLDER", help="this data set instead, where you have it")
    parser.add_argument("--tensoir", type=Path, metavar="FOLDER", help="a scene of TensoIR-Synthetic instead")
    parser.add_argument("--environments", type=Path, metavar="FOLDER", help="TensoIR's environment maps")
    parser.add_argument("--rivals", nargs="*", choices=RIVALS, default=list(USUAL), help="which others to run")
    options = parser.parse_args(argv)
    quick = options.quick
    options.resolution = options.resolution or (128 if quick else 512)
    options.views = options.views or (12 if quick else 16)
    options.spp = options.spp or (32 if quick else 128)
    if quick:
        options.assets, options.maps = options.assets or ["avocado"], ["strong"]
    return options


def rows(options: argparse.Namespace) -> list[Row]:
    if options.mesh:
        files: list[tuple[str, Path, UV]] = [(options.mesh.stem.lower(), options.mesh, "auto")]
    else:
        names = options.assets or list(ASSETS)
        files = [(n, find_asset(n, options.data), ASSETS[n][1]) for n in names]
    return [
        Row(name, file, "new" if options.uv == "new" else uv, kind)
        for name, file, uv in files
        for kind in KINDS
        if kind in options.maps
    ]


def label(row: Row) -> str:
    own = {"real": "", "strong": "_strong", "own_soft": "_soft"}
    return row.name + own.get(row.kind, f"_strong_{row.kind}")


def measure(row: Row, options: argparse.Namespace) -> tuple[dict[str, dict[str, float]], list[str]]:
    """All methods' figures of one row, ours first, and what there is to say about it."""
    size, frame = options.resolution, options.frame
    cameras = drawing.paper_cameras(size) if row.kind == "paper" else drawing.fibonacci(options.views, size)
    known = truth(row.file, row.name, drawing.fibonacci(1, size)[0], row.uv, row.strong)
    sky = options.data / "hdri" / "aircraft_workshop_01_1k.hdr"
    shots = (
        drawing.turned(cameras, sky, 1 if row.kind == "unknown" else 3) if row.soft else drawing.one_at_a_time(cameras)
    )
    depth, chosen = (2, {"bounces": 0}) if options.direct else (drawing.DEPTH, {})
    pictures = drawing.render(
        known.mesh, known.maps, shots, frame=frame, spp=options.spp, depth=depth, cache=options.cache
    )
    counts = seen(known, cameras)
    weights = observed_areas(known, counts)
    main_shots, main_pictures = drawing.together(shots, pictures) if row.kind == "paper" else (shots, pictures)

    judge = Judge(known, weights, options)
    fitted = ours(known, main_shots, main_pictures, frame, unknown=row.kind == "unknown", **chosen)
    methods = {"ours": judge(fitted.maps, frame, "ours", fitted.confidence) | {"seconds": fitted.seconds}}
    methods["ours"] |= calibration(known.maps, fitted.maps, fitted.spread, weights)
    methods["constant"] = judge(best_constant(known.maps, weights), frame, "constant")
    methods["other_seed"] = judge.differences(judge.relit(known.maps, frame, seed=2))
    all_maps: dict[str, Sequence[Maps]] = {"truth": known.maps, "ours": fitted.maps}
    if row.kind in ("real", "strong") and "together" in options.rivals:
        other = ours(known, *drawing.together(shots, pictures), frame, **chosen)
        methods["together"] = judge(other.maps, frame, "together") | {"seconds": other.seconds}
    steps: dict[str, str] = {}
    if wanted := [method for method in LOOPS if method in options.rivals and not row.soft]:
        with TemporaryDirectory() as folder:
            write_job(Path(folder), known, main_shots, main_pictures)
            for method in wanted:
                loop = naive(Path(folder), known, fitted.seconds, method)
                all_maps[method] = loop.maps
                figures = judge(loop.maps, "mitsuba", method)
                methods[method] = figures | {"seconds": loop.seconds, "steps": loop.steps}
                ended = " until the loss settled" if loop.settled else ""
                steps[method] = f"{int(loop.steps)} steps in {loop.seconds:.0f} s{ended}"
    if "naive" in methods:
        gain = methods["ours"]["relight_psnr_l"] - methods["naive"]["relight_psnr_l"]
        methods["ours"]["gain_over_naive_db"] = gain
    if options.out:
        folder = options.out / label(row)
        folder.mkdir(parents=True, exist_ok=True)
        trust = fitted.confidence[0] if fitted.confidence else None
        firsts = {method: maps[0] for method, maps in all_maps.items()}
        report.map_sheet(folder / "maps.png", firsts, trust, known.texels[0].covered)
        report.relit_sheet(folder / "relit.png", {"truth": judge.reference, **judge.shown})
    return methods, [*describe(known, weights, main_pictures), *fitted.notes, *_steps(steps)]


class Judge:
    """The measures of one object: holds the relit truth, so that every method meets the same pictures."""

    def __init__(self, known: Truth, weights: list[np.ndarray], options: argparse.Namespace):
        self.known, self.weights, self.options = known, weights, options
        hdri = options.data / "hdri" / "studio_small_03_1k.hdr"
        rigs = drawing.unseen(hdri, options.resolution, 1 if options.quick else 2)
        self.shots: list[Shot] = [shot for shots in rigs.values() for shot in shots]
        self.each = len(self.shots) // len(rigs)
        self.truth = self.relit(known.maps, options.frame)
        self.shown: dict[str, list[np.ndarray]] = {}

    @property
    def reference(self) -> list[np.ndarray]:
        return self.truth[:: self.each]

    def __call__(
        self, maps: Sequence[Maps], frame: Frame, method: str, confidence: Sequence[np.ndarray] | None = None
    ) -> dict[str, float]:
        result: dict[str, float] = asdict(map_errors(self.known.maps, maps, self.weights))
        if confidence is not None:
            trusted = confident_weights(self.weights, confidence)
            result |= {f"confident_{k}": v for k, v in asdict(map_errors(self.known.maps, maps, trusted)).items()}
        pictures = self.relit(maps, frame)
        self.shown[method] = pictures[:: self.each]
        return result | self.differences(pictures)

    def differences(self, pictures: Sequence[np.ndarray]) -> dict[str, float]:
        """Figures of relit pictures beside the truth's."""
        errors = [
            relight_errors(a[..., :3], b[..., :3], a[..., 3] > 0.5) for a, b in zip(self.truth, pictures, strict=True)
        ]
        return {f"relight_{k}": v for k, v in asdict(mean_errors(errors)).items()}

    def relit(self, maps: Sequence[Maps], frame: Frame, seed: int = 1) -> list[np.ndarray]:
        spp = max(8 if self.options.quick else RELIT_SPP, self.options.spp // 4)
        return drawing.render(
            self.known.mesh, maps, self.shots, frame=frame, spp=spp, seed=seed, cache=self.options.cache / "relit"
        )


def confident_weights(weights: Sequence[np.ndarray], confidence: Sequence[np.ndarray]) -> list[np.ndarray]:
    """`confident` over all texture sets at once."""
    flat = confident(
        np.concatenate([w.ravel() for w in weights])[None], np.concatenate([c.ravel() for c in confidence])[None]
    )[0]
    ends = np.cumsum([w.size for w in weights])[:-1]
    return [part.reshape(w.shape) for part, w in zip(np.split(flat, ends), weights, strict=True)]


def describe(known: Truth, weights: Sequence[np.ndarray], pictures: Sequence[np.ndarray]) -> list[str]:
    area = sum(float(a.sum()) for a in known.areas)
    share = sum(float(w.sum()) for w in weights) / area
    sizes = ", ".join(f"{len(t.covered)}² with {int(t.covered.sum())} covered" for t in known.texels)
    return [
        f"{len(pictures)} pictures of {pictures[0].shape[1]} x {pictures[0].shape[0]}; texels {sizes};"
        f" {share:.1%} of the surface is seen by at least {LEAST_VIEWS} cameras"
    ]


def _steps(steps: Mapping[str, str]) -> list[str]:
    return [f"{method}: {text}" for method, text in steps.items()]


if __name__ == "__main__":
    try:
        main()
    except MistyleError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
