"""Every verb that writes, with a small command line, and the inputs that these take."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mistyle.cli.main import main

SQUARE = """v -1 0 -1
v 1 0 -1
v 1 0.5 1
v -1 0 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 4/4 3/3 2/2
"""
SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective" id="front"><float name="fov" value="30"/>
<transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
<sampler type="independent"><integer name="sample_count" value="1"/></sampler></sensor>
<emitter type="constant"/><shape type="rectangle" id="wall"><bsdf type="diffuse" id="paint">
<rgb name="reflectance" value="0.5,0.4,0.3"/></bsdf></shape></scene>
"""
LIGHTS = {"type": "directional", "direction": [0, 1, 0], "irradiance": [1, 1, 1], "frame": "camera"}


def settings(**values: object) -> list[str]:
    return [word for name, value in values.items() for word in ("--set", f"{name.replace('__', '.')}={value}")]


RIG = settings(rig__kind="turntable", rig__views=2, rig__resolution=32, draw__spp=1)
ATLAS = settings(atlas__size=32, atlas__padding=2)
REPORT = settings(report__frames=4, report__resolution=64, report__spp=1)
PAINT = ["--preset", "draft", *RIG, *ATLAS, *REPORT, *settings(surface__samples=500, fit__refine="off")]
FIT = [
    *ATLAS,
    *REPORT,
    *settings(recover__solver="pictures", recover__iterations=2, recover__bounces=0, recover__joint=0),
]
JOBS = """[[job]]
mesh = "square.obj"
style = "style.png"
name = "one"
"""


@dataclass(frozen=True)
class Verb:
    """A verb that writes.

    words   its command line, given the folder of the inputs and the output folder
    covers  a stranger's files and folders that stand where it writes: each must be refused
    older   what an older version, which kept no record, would have left
    """

    words: Callable[[Path, Path], list[str]]
    covers: tuple[str, ...]
    older: tuple[str, ...]


def line(verb: str, *words: object) -> list[str]:
    return [verb, *map(str, words)]


RUN = ("run.json", "views/", "work/", "asset/", "report/")
VERBS = {
    "render": Verb(
        lambda i, o: line("render", i / "square.obj", "-o", o, *RIG),
        ("transforms.json", "az000.0_el+15.0.png", "camera.json/"),
        ("camera.json", "az000.0_el+15.0.png"),
    ),
    "bake": Verb(
        lambda i, o: line("bake", i / "square.obj", i / "shots", "-o", o, "--name", "baked", *ATLAS),
        ("baked.glb", "baked.json", "textures", "textures/baked_orm.png"),
        ("baked.json", "baked.glb"),
    ),
    "stylize": Verb(
        lambda i, o: line("stylize", i / "square.obj", i / "style.png", "-o", o, *PAINT), (*RUN, "views", "masks/"), RUN
    ),
    "demo": Verb(lambda i, o: line("demo", "-o", o, *PAINT), ("run.json", "stylized/", "work/"), RUN),
    "fit": Verb(
        lambda i, o: line("fit", i / "square.obj", i / "shots", "-o", o, "--lights", i / "lamps.json", *FIT),
        ("run.json", "scene/", "work/", "asset/", "report/"),
        ("run.json", "scene/", "asset/"),
    ),
    "fit --scene": Verb(
        lambda i, o: line(
            "fit", "--scene", i / "room.xml", "--references", i / "references", "--optimize", "*.reflectance.value",
            "--iterations", 2, "-o", o,
        ),
        ("run.json", "scene/", "pictures/", "report/", "work/"),
        ("run.json", "scene/", "pictures/"),
    ),
    "batch": Verb(
        lambda i, o: line("batch", i / "jobs.toml", "-o", o, "--threads", 2),
        ("plan.json", "batch.json", "batch.html", "shards/", "one/views/", "one/run.json"),
        ("plan.json", "batch.json", "shards/"),
    ),
    "shard": Verb(lambda i, o: line("shard", planned(i, o), "--index", 0), ("one/views/", "one/run.json"), ()),
    "farm": Verb(
        lambda i, o: line("farm", "export", i / "jobs.toml", "-o", o, "--as", "sbatch"),
        ("plan.json", "farm/mistyle.sbatch", "shards/", "one/asset/"),
        ("plan.json", "farm/mistyle.sbatch"),
    ),
    "compare": Verb(
        lambda i, o: line("compare", i / "a.png", i / "b.png", "-o", o, "--metrics", "psnr"),
        ("index.html", "compare.json", "compare.csv", "junit.xml", "pairs"),
        ("compare.json", "index.html"),
    ),
    "converge": Verb(
        lambda i, o: line("converge", i / "room.xml", "--with", "mitsuba:path", "--max-spp", 2, "--seeds", 2, "-o", o),
        ("converge.json", "converge.csv", "index.html"),
        ("converge.json", "index.html"),
    ),
    "export": Verb(
        lambda i, o: line("export", i / "run", "-o", o, "--formats", "maps", "glb", "obj"),
        ("square_style.glb", "square_style.mtl", "textures/square_style_normal.png"),
        ("square_style.export.json", "square_style.glb"),
    ),
    "lookdev": Verb(
        lambda i, o: line(
            "lookdev", i / "square.obj", "-o", o, "--size", 64, "--spp", 1, "--turntable", 2, "--frame", 32,
        ),
        ("lookdev.png", "lookdev.json", "turntable/001.png", "turntable.webp"),
        ("lookdev.json", "lookdev.png"),
    ),
    "verify": Verb(
        lambda i, o: line("verify", i / "run", "-o", o, "--no-render"),
        ("verify.json", "verify.json/"),
        ("verify.json",),
    ),
    "pack": Verb(lambda i, o: line("pack", "-o", o), ("install.sh", "SHA256SUMS"), ("SHA256SUMS", "install.sh")),
    "variations": Verb(
        lambda i, o: line("stylize", i / "square.obj", i / "style.png", "-o", o, "--variations", 1, *PAINT),
        ("variations.png", "variations.png/"),
        (),
    ),
}  # fmt: skip


def planned(inputs: Path, out: Path) -> Path:
    """A plan of one job, as `mistyle batch` resolves it, alone in a folder beside `out`; it works in `out`."""
    import tempfile
    from dataclasses import replace

    from mistyle.batch.pipeline import Choices, planned
    from mistyle.batch.plan import write_plan

    place = out.parent / f"plan of {out.name}"
    if not (place / "plan.json").is_file():
        plan = planned(inputs / "jobs.toml", out, Choices(threads=2))
        with tempfile.TemporaryDirectory(dir=out.parent) as scratch:
            told = json.loads(write_plan(replace(plan, out=Path(scratch))).read_text())
        place.mkdir()
        (place / "plan.json").write_text(json.dumps(told | {"out": str(out)}))
    return place / "plan.json"


def write_inputs(folder: Path) -> None:
    """One input of every kind, and a folder of views and a finished run made from them."""
    folder.mkdir()
    (folder / "square.obj").write_text(SQUARE)
    noise = np.random.default_rng(0)
    for name in ("style", "a", "b"):
        Image.fromarray((noise.random((32, 32, 3)) * 255).astype(np.uint8)).save(folder / f"{name}.png")
    (folder / "room.xml").write_text(SCENE)
    (folder / "references").mkdir()
    Image.fromarray(np.full((16, 16, 3), 128, np.uint8)).save(folder / "references" / "front.png")
    (folder / "lamps.json").write_text(json.dumps({"version": 1, "lights": [LIGHTS]}))
    words = [w for w in PAINT if w not in ("--set", "--preset", "draft")]
    chosen = "".join(
        f"{key} = {json.dumps(value) if value.isalpha() else value}\n"
        for key, _, value in (w.partition("=") for w in words)
    )
    (folder / "jobs.toml").write_text(f'{JOBS}preset = "draft"\n[job.settings]\n{chosen}')
    assert main(line("render", folder / "square.obj", "-o", folder / "shots", *RIG)) == 0
    assert main(line("stylize", folder / "square.obj", folder / "style.png", "-o", folder / "run", *PAINT)) == 0
