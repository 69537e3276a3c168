"""How the embedded stylizer looks: light in the albedo, and the choices of blind viewers.

`python -m benchmarks.look [VERB]`

figures   paints every style on every mesh with HEAD and measures the light in the albedo: `light.*`
sheets    paints them with HEAD and with --against COMMIT, and builds sheets for blind viewers with their key
score     compares viewers' answers with the key: `chosen.ship.KIND`, `chosen.style.KIND`, `chosen.shape.KIND`,
          `odd_one_out`, `chosen.ebsynth.KIND`, `chosen.finish.KIND` (KIND: oil, structured)
styles    writes the style pictures that are made here
Without a verb: figures, and the score of the answers in this folder. What was painted once is taken from --cache.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import common
from benchmarks.look import light as look_light
from benchmarks.look import paint as look_paint
from benchmarks.look import peer as look_peer
from benchmarks.look import score as look_score
from benchmarks.look import sheets as look_sheets
from benchmarks.look import styles as look_styles

HERE = Path(__file__).resolve().parent
KEY, ANSWERS = HERE / "key.json", HERE / "answers.json"
MESHES = {"spot": "spot.obj", "bunny": "stanford-bunny.obj", "teapot": "teapot.obj"}
QUICK_OPTIONS = ("--samples", "5000", "--atlas", "256")
VERBS = ("figures", "sheets", "score", "styles")


def options(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    made = common.parser(__doc__ or "")
    made.formatter_class = argparse.RawDescriptionHelpFormatter
    made.add_argument("verb", nargs="?", choices=VERBS)
    made.add_argument("--styles", metavar="A,B", help=f"which of {', '.join(look_styles.KINDS)} (default all)")
    made.add_argument("--meshes", metavar="A,B", help=f"which of {', '.join(MESHES)} (default all)")
    made.add_argument("--presets", default=None, metavar="A,B", help="figures: draft; sheets: draft,standard")
    made.add_argument("--against", metavar="COMMIT", help="sheets: the other candidate; figures: measure it too")
    made.add_argument("--whole", action="store_true", help="whole jobs with their fit, not the paint alone (slow)")
    made.add_argument("--set", action="append", default=[], metavar="K=V", help="a setting of HEAD's jobs, to try it")
    made.add_argument("--tests", default="choice,odd", help="which sheets: choice, odd, ebsynth, finish")
    made.add_argument("--ebsynth", type=Path, metavar="PROGRAM", help="for sheets of ebsynth (see peer.py)")
    made.add_argument("--vgg", type=Path, metavar="FILE", help="VGG-19 weights, for sheets of finish")
    made.add_argument("--out", type=Path, metavar="DIR", help="where sheets and key.json, or styles, are written")
    made.add_argument("--seed", type=int, default=0, help="of the sheets' shuffle")
    made.add_argument("--key", type=Path, default=KEY, metavar="FILE", help="score: the key (default: in this folder)")
    made.add_argument("--answers", type=Path, default=ANSWERS, metavar="FILE", help="score: the answers")
    made.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "mistyle-look", metavar="DIR")
    return made.parse_args(argv)


def chosen_names(text: str | None, known: Sequence[str], what: str) -> list[str]:
    """Names of a list such as "a,b"; all where there is none. SystemExit at an unknown one."""
    names = list(known) if text is None else [name for name in text.split(",") if name]
    wrong = [name for name in names if name not in known]
    if wrong:
        raise SystemExit(f"--{what}: there is no '{wrong[0]}'; choose among {', '.join(known)}")
    return names


def pieces(chosen: argparse.Namespace, presets: Sequence[str]) -> list[look_paint.Piece]:
    """Every style on every mesh with every preset, style after style."""
    styles = chosen_names(chosen.styles, list(look_styles.KINDS), "styles")
    meshes = chosen_names(chosen.meshes, list(MESHES), "meshes")
    more: tuple[str, ...] = () if chosen.whole else look_paint.PAINT_ONLY
    if chosen.quick:
        styles, meshes, presets = (styles if chosen.styles else styles[:1]), meshes[:1], presets[:1]
        more += QUICK_OPTIONS
    files = {style: look_styles.file_of(style, chosen.cache / "styles") for style in styles}
    folder = look_paint.DATA / "meshes" / "plain"
    return [
        look_paint.Piece(style, mesh, preset, files[style], folder / MESHES[mesh], more)
        for style in styles
        for mesh in meshes
        for preset in presets
    ]


def with_settings(found: Sequence[look_paint.Piece], pairs: Sequence[str]) -> list[look_paint.Piece]:
    """The pieces with further settings, which only HEAD's jobs get."""
    more = tuple(word for pair in pairs for word in ("--set", pair))
    return [look_paint.Piece(**vars(piece) | {"options": piece.options + more}) for piece in found]


def start_engines() -> None:
    """The renderer, as a job starts it."""
    from mistyle.jobs.start import start_engines
    from mistyle.stylization.settings import Settings

    start_engines(Settings())


def figures(chosen: argparse.Namespace) -> dict[str, float]:
    """`light.*` of HEAD, and as `light.other.*` of the other commit where one is named."""
    # The light is in the painting, not in what the fit does to it; an atlas of 1,024 is fine enough to tell.
    found = pieces(chosen, chosen_presets(chosen, "draft"))
    start_engines()
    trees = [(look_paint.this_tree(), with_settings(found, chosen.set), "light.")]
    if chosen.against:
        trees.append((look_paint.tree_at(chosen.against, chosen.cache), list(found), "light.other."))
    result: dict[str, float] = {}
    for tree, these, stem in trees:
        glbs = look_paint.painted(tree, these, chosen.cache)
        lights: dict[str, list[Any]] = {}
        for piece, glb in zip(these, glbs, strict=True):
            light = look_light.light_of(glb)
            lights.setdefault(piece.style, []).append(light)
            if light.ratio is not None:
                result[f"{stem}ratio.{piece.style}.{piece.mesh}.{piece.preset}"] = light.ratio
        mean = look_light.mean_light(list(lights.values()))
        result |= {name.replace("light.", stem, 1): value for name, value in mean.items()}
    return result


def chosen_presets(chosen: argparse.Namespace, default: str) -> list[str]:
    """The presets, as given or by default."""
    return chosen_names(chosen.presets or default, ["draft", "standard", "fine", "demo"], "presets")


def sheets(chosen: argparse.Namespace) -> dict[str, float]:
    """Paint, light and write the sheets and key.json into --out; counts them.

    Sheets of finish show the painter's result finished by VGG-19 ("head") and as it was ("other").
    """
    tests = chosen_names(chosen.tests, ["choice", "odd", "ebsynth", "finish"], "tests")
    if not chosen.out or ("choice" in tests and not chosen.against):
        raise SystemExit("sheets: name the other candidate with --against COMMIT, and a folder with --out DIR")
    if "finish" in tests and not chosen.vgg:
        raise SystemExit("sheets of finish need the weights of VGG-19: --vgg FILE (`mistyle models` says where from)")
    if "ebsynth" in tests and not chosen.ebsynth:
        raise SystemExit("sheets of ebsynth need its program: --ebsynth PROGRAM (peer.py says where it comes from)")
    found = pieces(chosen, chosen_presets(chosen, "draft,standard"))
    start_engines()
    ours = look_paint.this_tree()
    our_pieces = with_settings(found, chosen.set)
    done = [look_paint.finished(p, chosen.vgg) for p in our_pieces] if "finish" in tests else our_pieces
    # Each piece and its finish one after the other: the second job takes over the painting of the first.
    both = look_paint.painted(ours, [p for pair in zip(our_pieces, done, strict=True) for p in pair], chosen.cache)
    our_glbs, done_glbs, their_glbs, against = both[::2], both[1::2], both[::2], None
    if "choice" in tests:
        theirs = look_paint.tree_at(chosen.against, chosen.cache)
        their_glbs, against = look_paint.painted(theirs, found, chosen.cache), theirs.name
    lines, spent, seconds = [], [], []
    for piece, mine, end, other in zip(found, our_glbs, done_glbs, their_glbs, strict=True):
        kind = look_styles.KINDS[piece.style]
        if "choice" in tests:
            lines.append(look_sheets.build_choice(piece, kind, mine, other, chosen.out / "sheets", chosen.seed))
        if "odd" in tests:
            lines.append(look_sheets.build_odd(piece, kind, mine, chosen.out / "sheets", chosen.seed))
        if "ebsynth" in tests:
            peer = look_peer.baked_peer(chosen.ebsynth, piece, chosen.cache, chosen.quick)
            lines.append(
                look_sheets.build_choice(piece, kind, mine, peer, chosen.out / "sheets", chosen.seed, "ebsynth")
            )
            spent.append(look_paint.about(mine)["cpu"] / look_paint.about(peer)["cpu"])
        if "finish" in tests:
            lines.append(look_sheets.build_choice(piece, kind, end, mine, chosen.out / "sheets", chosen.seed, "finish"))
            seconds.append(look_paint.about(end)["finish"])
        print(f"sheets of {piece.label}", file=sys.stderr)
    about = {"head": ours.digest, "against": against, "seed": chosen.seed, "set": chosen.set}
    look_sheets.write_key(chosen.out / "key.json", lines, **about)
    ratio = {"ebsynth.cpu_ratio": sum(spent) / len(spent)} if spent else {}
    took = {"vgg.seconds": sum(seconds) / len(seconds)} if seconds else {}
    return {"sheets": float(len(lines))} | ratio | took


def score(chosen: argparse.Namespace) -> dict[str, float]:
    """`chosen.*` and `odd_one_out` of the answers."""
    return look_score.score(look_score.read_json(chosen.key), look_score.read_json(chosen.answers))


def styles(chosen: argparse.Namespace) -> dict[str, float]:
    """Write the made style pictures into --out."""
    if not chosen.out:
        raise SystemExit("styles: name a folder with --out DIR")
    names = [n for n in chosen_names(chosen.styles, list(look_styles.KINDS), "styles") if n in look_styles.MADE]
    return {"styles": float(len([look_styles.file_of(name, chosen.out) for name in names]))}


def main(argv: Sequence[str] | None = None) -> None:
    chosen = options(argv)
    if chosen.verb is not None:
        common.finish(globals()[chosen.verb](chosen), chosen.json)
        return
    result = figures(chosen)
    if chosen.key.exists() and chosen.answers.exists():
        result |= score(chosen)
    else:
        print(f"no answers yet: {json.dumps(str(chosen.answers))} and its key are not there", file=sys.stderr)
    common.finish(result, chosen.json)


if __name__ == "__main__":
    main()
