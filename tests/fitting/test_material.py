"""`mistyle fit` as a user runs it: from a folder of pictures to an asset, a Mitsuba scene and a report."""

import html
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mistyle
from mistyle.cli.main import main
from mistyle.core.camera import Camera, look_at
from mistyle.core.capture import in_memory
from mistyle.core.errors import InputRefused, UsageError
from mistyle.core.image import gaussian, srgb_from_linear
from mistyle.core.light import Ambient, Directional, Lights, SphericalGaussian, to_json
from mistyle.core.maps import flat_maps
from mistyle.core.mesh import Mesh
from mistyle.core.view import View
from mistyle.fitting.light import unknown_light
from mistyle.fitting.pipeline.job import MATERIAL_STAGES, MaterialJob
from mistyle.fitting.pipeline.material import hold_out, lights_in_order, place, references_of, scale_notes
from mistyle.fitting.pipeline.outlines import report_placement
from mistyle.fitting.settings.material import MaterialSettings, ReferenceSettings
from mistyle.io.cameras.views import read_views, write_views
from mistyle.io.images.write import write_png
from mistyle.io.read_mesh import read_mesh
from mistyle.jobs import plan as jobs_plan
from mistyle.jobs.progress import Progress
from mistyle.jobs.report.charts import Chart, svg
from mistyle.render.deferred.material_table import pack
from mistyle.render.deferred.renderer import MaterialRenderer
from mistyle.render.mitsuba import draw
from mistyle.solver.cameras.align import Alignment
from mistyle.stylization.pipeline.single_stages import tell_views

SIZE, SIDE = 64, 112
KEYS = [
    Directional((0.5, -0.5, -0.707), (2.5, 2.5, 2.5), "camera"),
    Directional((-0.6, 0.2, -0.775), (2.5, 2.4, 2.3), "camera"),
]
QUICK = {
    "recover": {"iterations": 24, "rounds": 1, "solver_iterations": 8, "bounces": 1, "bounce_samples": 8, "joint": 1}
    | {"joint_subsamples": 4},
    "report": {"frames": 4, "resolution": 96, "spp": 1},
}


def bowl(path: Path) -> None:
    """A shallow paraboloid over the unit square, UVs the square itself."""
    n = 17
    grid = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="xy"), -1).reshape(-1, 2)
    x, y = 2 * grid.T - 1
    lines = [f"v {a:.6f} {b:.6f} {0.25 * (1 - a * a - b * b):.6f}" for a, b in zip(x, y, strict=True)]
    normal = np.stack([0.5 * x, 0.5 * y, np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lines += [f"vn {a:.6f} {b:.6f} {c:.6f}" for a, b, c in normal]
    lines += [f"vt {0.02 + 0.96 * u:.6f} {0.02 + 0.96 * v:.6f}" for u, v in grid]
    for r in range(n - 1):
        for c in range(n - 1):
            a, b, d, e = (r * n + c + 1, r * n + c + 2, (r + 1) * n + c + 2, (r + 1) * n + c + 1)
            lines.append("f " + " ".join(f"{i}/{i}/{i}" for i in (a, b, d, e)))
    path.write_text("\n".join(lines) + "\n")


def truth() -> object:
    rng = np.random.default_rng(4)
    noise = [gaussian(rng.normal(size=(SIZE, SIZE)).astype(np.float32), 3) for _ in range(6)]
    unit = [n / n.std() for n in noise]
    albedo = np.clip(0.4 + 0.12 * np.stack(unit[:3], -1), 0.05, 0.9).astype(np.float32)
    tilt = 0.1 * np.stack(unit[3:5], -1)
    normal = np.concatenate([tilt, np.sqrt(np.maximum(1 - (tilt**2).sum(-1, keepdims=True), 0.1))], -1)
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    roughness = np.clip(0.45 + 0.1 * unit[5], 0.2, 0.8).astype(np.float32)
    return replace(flat_maps(SIZE), albedo=albedo, normal=normal, roughness=roughness)


def orbit(count: int, low: float, side: int) -> list[Camera]:
    """Cameras around the bowl, at three heights from `low` (radians) on."""
    cameras = []
    for k in range(count):
        angle, high = 2.4 * k, low + 0.35 * (k % 3)
        place = 4 * np.array([np.cos(angle) * np.cos(high), np.sin(angle) * np.cos(high), np.sin(high)])
        cameras.append(look_at(place.tolist(), fov=30, size=(side, side), name=f"c{k:02d}"))
    return cameras


def photographed(mesh: Mesh, cameras: list[Camera], rigs: list[Lights]) -> list[View]:
    """The true material from every camera under its lights."""
    blank = [np.zeros((*camera.size, 3), np.float32) for camera in cameras]
    traced = draw.tracer(mesh)
    renderer, table = MaterialRenderer(traced, in_memory(cameras, rigs, blank), [(SIZE, SIZE)]), pack([truth()])
    views = []
    for k, camera in enumerate(cameras):
        hits = draw.gbuffer(traced, camera)
        image, coverage = renderer.image_and_coverage(table, k)
        fields = (image, hits.depth, hits.normal, hits.uv, hits.part, hits.mask, coverage)
        views.append(View(camera, *fields))
    return views


def one_by_one(folder: Path, mesh: Mesh, places: list[Camera]) -> None:
    """References from every place under each of KEYS, with their lights.json."""
    cameras = [replace(camera, name=f"{camera.name}_{j}") for camera in places for j in range(len(KEYS))]
    rigs: list[Lights] = [(light,) for _ in places for light in KEYS]
    write_views(folder, photographed(mesh, cameras, rigs), ())
    named = {camera.name: rig for camera, rig in zip(cameras, rigs, strict=True)}
    (folder / "lights.json").write_text(json.dumps(to_json((), named)))


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """A mesh file and a folder of 24 references, EXR, of 12 cameras under two lights, with their lights.json."""
    folder = tmp_path_factory.mktemp("material")
    bowl(folder / "bowl.obj")
    one_by_one(folder / "shots", read_mesh(folder / "bowl.obj", size=SIZE).mesh, orbit(12, 0.55, SIDE))
    return folder


@pytest.fixture(scope="module")
def fitted(shots):
    summary = mistyle.fit(shots / "bowl.obj", shots / "shots", shots / "out", atlas={"size": SIZE}, **QUICK)
    return shots / "out", summary


def test_the_material_explains_pictures_that_were_held_out(fitted):
    out, summary = fitted
    assert summary["figures"]["psnr_held_out"] > 40
    assert 0.95 < summary["figures"]["outline_overlap_least"] <= summary["figures"]["outline_overlap"] <= 1
    record = json.loads((out / "run.json").read_text())
    assert sum(p["held_out"] for p in record["pictures"]) == 2 and len(record["pictures"]) == 24
    assert min(p["outline_overlap"] for p in record["pictures"]) == summary["figures"]["outline_overlap_least"]
    assert {"c00_0", "c11_1"} <= {p["name"] for p in record["pictures"]}
    assert any("light of the first picture; the pictures had 2" in note for note in record["notes"])
    page = (out / "report" / "index.html").read_text()
    assert "fitted to" in page and "<svg" in page and "held out" in page
    for path in ("asset", "scene", "report", "picture"):
        assert Path(summary[path]).is_file()


def test_the_mitsuba_scene_shows_what_the_reference_shows(fitted, shots):
    """Read by `mi.load_file` with nothing of ours registered in the scene: Mitsuba's own plugins only."""
    import mitsuba as mi

    out, summary = fitted
    text = Path(summary["scene"]).read_text()
    assert "mistyle" not in text
    scene = mi.load_file(summary["scene"])
    picture = np.array(mi.render(scene, sensor=0, spp=64))[..., :3]
    from mistyle.io.read import read_exr

    planes = read_exr(shots / "shots" / "c00_0.exr")
    reference = np.stack([planes[c] for c in "RGB"], -1)
    inside = planes["A"] > 0.999
    error = srgb_from_linear(picture)[inside] - srgb_from_linear(reference)[inside]
    assert 10 * np.log10(1 / np.mean(error**2)) > 34


@pytest.mark.parametrize("align", [False, True])
def test_cameras_that_do_not_fit_the_mesh_are_said(shots, tmp_path, capsys, monkeypatch, align):
    """Turned by 90 degrees about X, as if Z were up."""
    from mistyle.io.cameras.captures import read_shots

    asset = read_mesh(shots / "bowl.obj", size=SIZE)
    job = MaterialJob(shots / "bowl.obj", shots / "shots", tmp_path, MaterialSettings(), "bowl")
    captures, read = references_of(job), read_shots(shots / "shots")
    right = place(job, asset, captures, read, lambda done: None)
    assert min(right.overlap) > 0.95 and right.notes == ()
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    turned = tuple(replace(c, world_from_cam=turn @ c.world_from_cam) for c in captures.cameras)
    if align:  # what was asked for already is not advised again
        monkeypatch.setattr("mistyle.solver.cameras.align.align_by_masks", lambda *_: Alignment(turn, (), ()))
        job = replace(job, settings=MaterialSettings(references=ReferenceSettings(align=True)))
    else:
        captures = replace(captures, cameras=turned)
    wrong, progress = place(job, asset, captures, read, lambda done: None), Progress()
    report_placement(wrong, progress)
    (note,) = progress.notes
    assert note.startswith("Warning: the cameras do not fit the mesh in ") and "less than 0.8" in note
    assert ("use --align" in note) == ("file has Z up" in note) == (not align)
    assert ("--refine-poses" in note) == align
    assert wrong.figures["outline_overlap_least"] == min(wrong.overlap) < 0.8
    printed = capsys.readouterr().err
    assert note in printed and f"c00_0 {wrong.overlap[0]:.2f}, " in printed
    blind = [replace(shot, picture=shot.picture.with_suffix(".png"), alpha_of=None) for shot in read]
    monkeypatch.setattr("mistyle.io.cameras.captures.outline_of", lambda shot, seen: None)
    if not align:
        (note,) = place(job, asset, captures, blind, lambda done: None).notes
        assert "not checked whether the cameras fit" in note


def test_views_that_do_not_fit_are_said_before_they_are_baked(shots):
    asset, views = read_mesh(shots / "bowl.obj", size=SIZE), read_views(shots / "shots")[:4]
    progress = Progress(quiet=True)
    tell_views(asset.mesh, views, progress)
    assert progress.notes == []
    swapped = [
        replace(view, camera=replace(other.camera, name=f"s{k}"))
        for k, (view, other) in enumerate(zip(views, views[::-1], strict=True))
    ]
    tell_views(asset.mesh, swapped, progress)
    assert "do not fit the mesh" in progress.notes[0] and "--align" not in progress.notes[0]


def test_a_second_run_takes_everything_over(fitted, shots):
    out, _ = fitted
    before = {p.name: p.read_bytes() for p in (out / "asset" / "textures").iterdir()}
    again = mistyle.fit(shots / "bowl.obj", shots / "shots", out, atlas={"size": SIZE}, **QUICK)
    assert {p.name: p.read_bytes() for p in (out / "asset" / "textures").iterdir()} == before
    assert again["figures"]["psnr_held_out"] > 40
    assert not list((out / "work").glob("checkpoint-*"))


def test_a_dry_run_counts_and_makes_nothing(shots, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(jobs_plan, "slowness", lambda threads: threads / 2)
    words = ["fit", str(shots / "bowl.obj"), str(shots / "shots"), "-o", str(tmp_path / "out"), "--dry-run"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pictures"] == 24 and told["megapixels"] == pytest.approx(24 * SIDE**2 / 1e6, abs=0.1)
    left_out = ("light", "photometry", "exposures")
    assert [row["stage"] for row in told["stages"]] == [s for s in MATERIAL_STAGES if s not in left_out]
    assert 5 < told["seconds"] < 1000 and told["memory_gb"] >= max(told["peaks_gb"].values()) - 0.01
    assert main([*words, "--set", "recover.iterations=4800"]) == 0
    text = capsys.readouterr().out
    assert "24 pictures" in text and "memory at most about" in text
    assert main([*words, "--memory", "0.3G"]) == 2 and "the fit needs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_realityscans_cameras_fit_the_mesh_that_they_show(shots, tmp_path, capsys):
    """Views of RealityScan's table, in the units of the mesh's file, whose outlines are the mesh's."""
    from scipy.spatial.transform import Rotation

    from mistyle.geometry.similarity import moved_camera
    from mistyle.io.cameras.captures import read_shots

    asset = read_mesh(shots / "bowl.obj", size=SIZE)
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    body_from_camera = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    lines = ["#cameras 4", "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"]
    cameras = orbit(4, 0.55, SIDE)
    for view in photographed(asset.mesh, cameras, [(KEYS[0],)] * 4):
        camera = moved_camera(view.camera, np.linalg.inv(asset.source.work_from_user))
        turned = Rotation.from_matrix(enu_from_ned.T @ camera.world_from_cam[:3, :3] @ body_from_camera.T)
        angles, film = turned.as_euler("ZYX", degrees=True), 36 * camera.focal / SIDE
        lines.append(
            ",".join([f"{camera.name}.JPG", *map(repr, map(float, [*camera.position, *angles, film])), *"0" * 8])
        )
        pixels = np.concatenate([srgb_from_linear(np.clip(view.rgb, 0, 1)), view.coverage[..., None]], axis=-1)
        write_png(tmp_path / f"{camera.name}.png", pixels)
    (tmp_path / "registration.csv").write_text("\n".join(lines) + "\n")
    job = MaterialJob(shots / "bowl.obj", tmp_path, tmp_path / "out", MaterialSettings(), "bowl", lights="unknown")
    placed = place(job, asset, references_of(job), read_shots(tmp_path), lambda done: None)
    assert min(placed.overlap) > 0.95
    words = ["fit", str(shots / "bowl.obj"), str(tmp_path), "-o", str(tmp_path / "out"), "--light", "unknown", "--json"]
    assert main([*words, "--dry-run"]) == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == 4


def test_a_light_that_nobody_knows(shots, tmp_path, monkeypatch):
    """A sun in a dim sky, found beside the material, explains pictures that the fit has not seen."""
    asset = read_mesh(shots / "bowl.obj", size=SIZE)
    sun = SphericalGaussian(axis=(0.36, 0.48, 0.8), sharpness=20.0, amplitude=(4.0, 4.0, 4.0))
    cameras = orbit(14, 0.5, 64)
    rigs = [(sun, Ambient((0.2, 0.2, 0.2)))] * len(cameras)
    write_views(tmp_path / "shots", photographed(asset.mesh, cameras, rigs), ())
    monkeypatch.setattr(unknown_light, "OBSERVATIONS", 3000)
    monkeypatch.setattr(unknown_light, "STEPS", (5, 3))
    few = QUICK | {"recover": {"solver": "texels", "rounds": 1, "bounces": 0, "solver_iterations": 6, "joint": 0}}
    summary = mistyle.fit(
        shots / "bowl.obj", tmp_path / "shots", tmp_path / "out", lights="unknown", atlas={"size": SIZE},
        references={"hold_out": 2}, **few,
    )  # fmt: skip
    assert summary["figures"]["psnr_held_out"] > 30
    assert "envmap" in Path(summary["scene"]).read_text()
    (free,) = scale_notes(MaterialJob(Path("a"), Path("b"), Path("c"), MaterialSettings(), "a", "unknown"))
    assert "--albedo-of" in free and free in summary["notes"]
    assert free.partition(":")[0] in html.unescape((tmp_path / "out" / "report" / "index.html").read_text())


def test_a_scale_that_something_fixes_needs_no_note():
    lit = MaterialSettings.model_validate({"light": {"albedo": (0.18, 0.18, 0.18)}})
    carded = MaterialJob(Path("a"), Path("b"), Path("c"), lit, "a", "unknown", albedo_of=Path("m.png"))
    assert scale_notes(carded) == scale_notes(replace(carded, lights=None, albedo_of=None)) == ()
    assert scale_notes(replace(carded, settings=MaterialSettings())) != ()


def test_pictures_are_held_out_evenly_and_by_light():
    cameras = [look_at((0, 0, 4), fov=30, size=(4, 4), name=f"v{k}") for k in range(48)]
    rigs = [(KEYS[k % 2],) for k in range(48)]
    captures = in_memory(cameras, rigs, [np.ones((4, 4, 3), np.float32)] * 48)
    kept, held = hold_out(captures, ReferenceSettings())
    assert len(held) == 4 and sorted(kept + held) == list(range(48))
    assert {k % 2 for k in held} == {0, 1}
    kept, held = hold_out(captures, ReferenceSettings(hold_out=0, hold_out_light=1))
    assert held == list(range(1, 48, 2)) and kept == list(range(0, 48, 2))
    assert lights_in_order(rigs) == [0, 1] * 24
    with pytest.raises(InputRefused, match="none is left"):
        hold_out(captures, ReferenceSettings(hold_out=48))


def test_pictures_lit_by_a_scene_file_are_refused(shots, tmp_path):
    (tmp_path / "lights.json").write_text('{"lights": [{"type": "scene", "file": "studio.xml"}]}')
    with pytest.raises(InputRefused, match="studio.xml"):
        mistyle.fit(shots / "bowl.obj", shots / "shots", tmp_path / "out", lights=tmp_path / "lights.json")
    assert not (tmp_path / "out").exists()


def test_usage(capsys):
    assert main(["fit"]) == 2
    assert "MESH" in capsys.readouterr().err
    assert main(["fit", "a.obj", "b", "-o", "c", "--list"]) == 2
    assert "--scene" in capsys.readouterr().err
    assert main(["fit", "a.obj", "b", "--scene", "s.xml"]) == 2
    assert main(["fit", "nothing.obj", "b", "-o", "c"]) == 3
    assert main(["fit", "--print-config"]) == 0
    assert "[recover]" in capsys.readouterr().out
    with pytest.raises(UsageError):
        mistyle.fit("a.obj", "b", "c", recover={"iteration": 3})


def test_charts_draw_what_they_are_given():
    drawn = svg(Chart("loss <b>", {"a": [1.0, 0.1, float("nan"), 0.01]}, log=True, x_label="step"))
    assert "&lt;b&gt;" in drawn and "<b>" not in drawn and drawn.count("<polyline") == 1
    points = drawn.split('points="')[1].split('"')[0].split()
    assert len(points) == 3
    heights = [float(p.split(",")[1]) for p in points]
    assert heights[1] - heights[0] == pytest.approx((heights[2] - heights[0]) / 2, abs=0.2)
    bars = svg(Chart("psnr", {"x": [30.0, 40.0]}, bars=True))
    assert bars.count("<rect") == 2
    assert "nothing to draw" in svg(Chart("empty", {"a": []}))


SCENE = """<scene version="3.9.0">
  <integrator type="direct"/>
  <sensor type="perspective" id="{id}"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="24"/><integer name="height" value="24"/><rfilter type="box"/>
    </film>
  </sensor>
  <emitter type="constant"/>
  <shape type="rectangle" id="wall"><bsdf type="twosided"><bsdf type="diffuse" id="paint">
    <texture type="bitmap" name="reflectance"><string name="filename" value="{file}"/></texture></bsdf></bsdf></shape>
</scene>"""


def test_a_mitsuba_scene_is_fitted_from_the_command_line(tmp_path, capsys):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(0)
    write_png(tmp_path / "grey.png", np.full((8, 8, 3), 0.5, np.float32))
    write_png(tmp_path / "true.png", rng.uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32))
    (tmp_path / "shots").mkdir()
    (tmp_path / "room.xml").write_text(SCENE.format(id="front", file="grey.png"))
    (tmp_path / "truth.xml").write_text(SCENE.format(id="front", file="true.png"))
    picture = np.array(mi.render(mi.load_file(str(tmp_path / "truth.xml")), spp=64))[..., :3]
    from mistyle.io.images.write import write_exr

    write_exr(tmp_path / "shots" / "front.exr", dict(zip("RGB", np.moveaxis(picture, -1, 0), strict=True)))
    scene = str(tmp_path / "room.xml")
    assert main(["fit", "--scene", scene, "--list"]) == 0
    assert "wall.bsdf.brdf_0.reflectance" in capsys.readouterr().out
    command = ["fit", "--scene", scene, "--references", str(tmp_path / "shots"), "-o", str(tmp_path / "out")]
    assert main([*command, "--optimize", "paint.reflectanc"]) == 2
    assert "wall.bsdf.brdf_0.reflectance" in capsys.readouterr().err
    assert main([*command, "--optimize", "wall.bsdf.reflectance", "--iterations", "60", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["figures"]["psnr_after"] > summary["figures"]["psnr_before"] + 8
    again = mi.load_file(summary["scene"])
    now = np.array(mi.render(again, spp=64))[..., :3]
    assert np.abs(now - picture).mean() < 0.3 * np.abs(0.5**2.2 - picture).mean()
    assert (tmp_path / "out" / "pictures" / "front.png").is_file()
    assert "fitted to" in (tmp_path / "out" / "report" / "index.html").read_text()
