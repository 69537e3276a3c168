"""The Python API: records in and out, a differentiable renderer, verbs with a face, and the notebook."""

import ast
import inspect
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import mistyle
from mistyle import api
from mistyle.api import html
from mistyle.api.settings import FitSettings, LookdevSettings, StylizeSettings
from mistyle.core.errors import InputRefused, UsageError
from mistyle.render.mitsuba import device
from mistyle.render.mitsuba import scene as scenery
from mistyle.render.mitsuba.emitters import emitters
from tests.render.deferred.test_seam import SIZES, crop, random_maps, sphere, torus
from tests.solver.test_recover import DIRECT, QUICK, strong_maps
from tests.solver.test_scene_fit import CAMERAS, COLOUR, flat, references
from tests.support.helpers import ROOT
from tests.support.notebooks import execute
from tests.support.verbs import SQUARE

KEY = mistyle.Directional((-0.5, -0.5, -0.7071), (2.0, 1.5, 1.0), "camera")
LAMP = mistyle.Point((-2.5, 1.5, 2.0), (12.0, 9.0, 6.0))
BESIDE = mistyle.Point((-3.0, 0.5, 3.0), (12.0, 9.0, 6.0), "camera")
MAPS = ("albedo", "normal", "roughness", "metallic")
NOTEBOOK = ROOT / "scenes" / "fit_a_material.ipynb"


def test_importing_mistyle_loads_nothing_and_the_names_come_when_asked_for():
    program = (
        "import sys, time; before = time.perf_counter(); import mistyle; took = time.perf_counter() - before\n"
        "heavy = {'numpy', 'pydantic', 'mistyle.api'} & set(sys.modules)\n"
        "mistyle.recover; print(took, sorted(heavy), 'mitsuba' in sys.modules, 'torch' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    took, _, rest = said.stdout.strip().partition(" ")
    assert rest == "[] False False" and float(took) < 0.1


def test_every_public_name_is_there_for_people_and_for_editors():
    assert set(mistyle.__all__) == {"__version__", *api.__all__} and set(mistyle.__all__) <= set(dir(mistyle))
    assert all(getattr(mistyle, name) is getattr(api, name) for name in api.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        mistyle.no_such_name  # noqa: B018
    block = next(node for node in ast.parse(Path(mistyle.__file__).read_text("utf-8")).body if isinstance(node, ast.If))
    typed = [alias.name for line in block.body if isinstance(line, ast.ImportFrom) for alias in line.names]
    assert typed == api.__all__
    packages = {path.name for path in (ROOT / "mistyle").iterdir() if path.is_dir()}
    assert not packages & set(mistyle.__all__)  # importing a package would overwrite the function


@pytest.mark.parametrize("name", [n for n in api.__all__ if inspect.isfunction(getattr(api, n))])
def test_every_function_says_what_it_takes(name):
    """Typed arguments, each named in the text."""
    function = getattr(mistyle, name)
    text, parameters = inspect.getdoc(function) or "", inspect.signature(function).parameters
    assert text and all(p.annotation is not p.empty for p in parameters.values())
    if function.__module__.startswith("mistyle.api"):
        assert all(k in text for k in parameters if k not in ("mesh", "path", "folder", "out")), name


def test_the_settings_of_the_verbs_are_those_that_there_are():
    from mistyle.deliver.lookdev.job import LookSettings
    from mistyle.fitting.settings.material import MaterialSettings
    from mistyle.stylization.settings import Settings

    for typed, model in ((StylizeSettings, Settings), (FitSettings, MaterialSettings), (LookdevSettings, LookSettings)):
        assert set(typed.__annotations__) == set(model.model_fields), typed


@pytest.fixture(scope="module")
def square(tmp_path_factory) -> Path:
    """A folder with square.obj and, in shots/, two lit views of it with their cameras and light."""
    from mistyle.io.cameras.views import write_views

    folder = tmp_path_factory.mktemp("square")
    (folder / "square.obj").write_text(SQUARE)
    cameras = [mistyle.orbit(a, 60, distance=4, fov=30, size=(24, 24)) for a in (0, 90)]
    light = mistyle.Ambient((1.0, 1.0, 1.0))
    views = mistyle.render_views(mistyle.read_mesh(folder / "square.obj"), None, cameras, light, spp=4)
    write_views(folder / "shots", views.views, (light,))
    return folder


def plain_picture(mesh, maps, camera, light):
    """`mi.render` through pixel centres: full textures, one delta light, one sample without jitter."""
    import mitsuba as mi

    sensor = scenery.sensor_dict(camera)
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
    described = {"type": "scene", "integrator": DIRECT, "sensor": sensor, "light": emitters([light], camera)[0]}
    described |= scenery.object_shapes(mesh, maps, frame="mikkt")
    return np.array(mi.render(mi.load_dict(described), spp=1, seed=0))[..., :3]


def leaves(maps) -> list[dict[str, torch.Tensor]]:
    return [{n: torch.tensor(getattr(m, n), requires_grad=True) for n in MAPS} for m in maps]


@pytest.mark.parametrize("light", [KEY, LAMP, BESIDE])
def test_the_renderer_draws_what_mitsuba_draws(rng, light):
    """The same picture from records, torch tensors and Dr.Jit tensors, of two texture sets, shadows included."""
    device.use()
    import mitsuba as mi

    mesh, maps, camera = torus(), random_maps(rng, SIZES), crop()
    renderer = mistyle.Renderer(mesh, camera, light)
    picture, truth = renderer.image(maps), plain_picture(mesh, maps, camera, light)
    lit = (truth.max(-1) > 0).mean()
    assert 0.1 < lit < 0.95 * renderer.mask().mean()  # some of what is seen lies in shadow
    assert (np.abs(picture - truth).max(-1) > 2e-4).mean() < 1e-3
    tensors = renderer.image([{n: mi.TensorXf(getattr(m, n)) for n in MAPS} for m in maps])
    assert isinstance(tensors, mi.TensorXf) and np.array_equal(np.array(tensors), picture)
    image = renderer.image(leaves(maps))
    assert image.requires_grad and np.array_equal(image.detach().numpy(), picture)
    still = renderer.image([{n: v.detach() for n, v in one.items()} for one in leaves(maps)])
    assert not still.requires_grad and np.array_equal(still.numpy(), picture)


@pytest.mark.parametrize("name, step", [("albedo", 1e-2), ("normal", 2e-3), ("roughness", 2e-3), ("metallic", 1e-2)])
def test_its_gradient_equals_central_differences(rng, name, step):
    """Of a loss over two cameras of different sizes, whose gradient is taken once, after both were drawn."""
    cameras = [crop(32), mistyle.orbit(200, 10, distance=4, fov=30, size=(24, 40))]
    lights = [(KEY, mistyle.Ambient((0.3, 0.3, 0.3))), (LAMP,)]
    renderer, maps = mistyle.Renderer(torus(bumps=0), cameras, lights), random_maps(rng, SIZES, tilt=0.2)
    adjoints = [torch.from_numpy(rng.normal(size=(*c.size, 3))) for c in cameras]

    def loss(sets):
        return sum((renderer.image(sets, k).double() * adjoints[k]).sum() for k in (0, 1))

    sets = leaves(maps)
    loss(sets).backward()
    direction = [torch.from_numpy(rng.normal(size=one[name].shape).astype(np.float32)) for one in sets]
    ends = []
    for sign in (1, -1):
        moved = [{**one, name: (one[name] + sign * step * d).detach()} for one, d in zip(sets, direction, strict=True)]
        ends.append(float(loss([{n: v.detach() for n, v in one.items()} for one in moved])))
    analytic = sum(float((one[name].grad * d).double().sum()) for one, d in zip(sets, direction, strict=True))
    typical = float(sum(one[name].grad.square().sum() for one in sets) ** 0.5)
    assert abs(analytic - (ends[0] - ends[1]) / (2 * step)) < 0.02 * typical


def test_gradients_in_drjit_equal_those_in_torch_whose_bytes_are_the_same_in_every_run(rng):
    device.use()
    import drjit as dr
    import mitsuba as mi

    mesh, maps = torus(), random_maps(rng, SIZES)
    renderer = mistyle.Renderer(mesh, crop(), (KEY, mistyle.Ambient((0.3, 0.2, 0.1))))
    adjoint = rng.normal(size=(48, 48, 3)).astype(np.float32)
    found = []
    for _ in range(2):
        sets = leaves(maps)
        (renderer.image(sets) * torch.from_numpy(adjoint)).sum().backward()
        found.append([one[n].grad.numpy() for one in sets for n in MAPS])
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*found, strict=True))
    tensors = [{n: mi.TensorXf(getattr(m, n)) for n in MAPS} for m in maps]
    dr.enable_grad(*(v for one in tensors for v in one.values()))
    dr.backward(dr.sum(renderer.image(tensors) * mi.TensorXf(adjoint), axis=None))
    theirs = [np.array(dr.grad(one[n])) for one in tensors for n in MAPS]
    for ours, other in zip(found[0], theirs, strict=True):
        assert np.linalg.norm(ours - other) < 1e-5 * np.linalg.norm(ours)


def test_maps_that_are_left_out_are_neutral_and_kinds_may_be_mixed(rng):
    renderer = mistyle.Renderer(sphere(), crop(16), KEY)
    grey = mistyle.flat_maps(8)
    albedo = torch.tensor(grey.albedo, requires_grad=True)
    full = renderer.image(grey)
    assert np.array_equal(renderer.image({"albedo": albedo}).detach().numpy(), full)
    assert np.array_equal(renderer.image({**vars(grey), "albedo": albedo}).detach().numpy(), full)
    assert np.array_equal(renderer.image({"roughness": grey.roughness}), full)


def test_what_the_renderer_refuses():
    sky = mistyle.Environment(np.ones((4, 8, 3), np.float32))
    with pytest.raises(UsageError, match="found Environment; expected Directional, Point and Ambient"):
        mistyle.Renderer(sphere(), crop(8), (KEY, sky))
    with pytest.raises(UsageError, match="found 3 rigs and 0 lights for 2 cameras"):
        mistyle.Renderer(sphere(), [crop(8)] * 2, [(KEY,)] * 3)
    renderer = mistyle.Renderer(sphere(), crop(8), KEY)
    with pytest.raises(ValueError, match="2 sets of maps came for 1"):
        renderer.image([mistyle.flat_maps(4)] * 2)
    with pytest.raises(ValueError, match="'colour'"):
        renderer.image({"colour": np.zeros((4, 4, 3))})
    with pytest.raises(ValueError, match=r"roughness has the shape \(4, 5\); expected \(4, 4\)"):
        renderer.image({"albedo": np.zeros((4, 4, 3)), "roughness": np.zeros((4, 5))})


def test_the_renderer_and_rendered_views_show_one_material():
    """Without indirect light, inside and away from edges: they differ by the views' antialiasing alone."""
    mesh, camera = sphere(), mistyle.orbit(30, 20, distance=4, fov=30, size=(48, 48))
    view = mistyle.render_views(mesh, strong_maps(), camera, KEY, spp=64, integrator="direct")[0]
    picture, inside = mistyle.Renderer(mesh, camera, KEY).image(strong_maps()), view.coverage == 1
    apart = mistyle.compare(view, picture, inside, metrics=("psnr", "relmse"))
    assert inside.sum() > 500 and apart["psnr"] > 36 and apart.pixels == inside.sum()


def test_views_of_an_asset_are_captures(square):
    asset = mistyle.read_mesh(square / "square.obj")
    cameras = [mistyle.orbit(a, 60, distance=4, fov=30, size=(24, 24)) for a in (0, 90)]
    views = mistyle.render_views(asset, None, cameras, mistyle.Ambient((1.0, 1.0, 1.0)), spp=4)
    assert len(views) == 2 and views[1].camera is cameras[1] and len(views[:1]) == 1
    captures = views.captures
    rgb, counts = captures.load(0)
    assert captures.cameras == tuple(cameras) and counts.sum() and (views[0].coverage[counts] >= 0.999).all()
    assert rgb is views[0].rgb
    shown = views._repr_html_()
    assert shown.count("data:image/webp") == 2 and cameras[0].name in shown


@pytest.fixture(scope="module")
def fitted():
    """A sphere with known maps and its recovery from pictures of ten cameras."""
    mesh, truth = replace(sphere(), parts=("<i>ball</i>",)), strong_maps()
    places = [mistyle.orbit(36 * k, (-35, 0, 35)[k % 3], distance=4, fov=30, size=(64, 64)) for k in range(10)]
    cameras = [replace(c, name=f"{c.name}.{k}") for c in places for k in range(2)]
    lights = [(KEY,), (mistyle.Directional((0.6, -0.3, -0.74), (2.0, 2.0, 2.0), "camera"),)] * 10
    views = mistyle.render_views(mesh, truth, cameras, lights, spp=16, integrator="direct")
    heard = []
    fit = mistyle.recover(mesh, views.captures, 64, settings=QUICK, progress=heard.append)
    assert heard[-1] == 1
    return truth, views, fit


def test_a_material_is_recovered_in_memory(fitted):
    truth, _, fit = fitted
    sure = fit.texels[0].covered & (fit.confidence[0] > 0.5) & (fit.seen[0] >= 3)
    assert fit.figures["seen_share"] > 0.8 and sure.sum() > 0.5 * fit.texels[0].covered.sum()
    assert fit.figures["residual"] < 0.03 and len(fit.residuals) == 20
    grey = mistyle.flat_maps(64)
    for name, share in (("albedo", 0.2), ("normal", 0.25), ("roughness", 0.4)):
        wanted = getattr(truth, name)
        apart = [mistyle.compare(wanted, getattr(m, name), sure, kind="data")["rmse"] for m in (fit.maps[0], grey)]
        assert apart[0] < share * apart[1], (name, apart)
    unseen = fit.seen[0] == 0
    assert (fit.confidence[0][unseen] == 0).all() and not fit.maps[0].known[unseen].any()


def test_the_fit_shows_itself(fitted):
    _, _, fit = fitted
    shown = fit._repr_html_()
    assert shown.count("data:image/webp") == 5 and "confident_share" in shown
    assert "&lt;i&gt;ball&lt;/i&gt;" in shown and "<i>" not in shown
    assert len(shown) < 100_000


def test_what_recover_refuses(fitted):
    _, views, _ = fitted
    dark = replace(views.captures, lights=((),) * len(views))
    with pytest.raises(InputRefused, match='found no light for the picture.*lights="unknown"'):
        mistyle.recover(sphere(), dark, 16)
    with pytest.raises(UsageError, match="did you mean 'iterations'"):
        mistyle.recover(sphere(), views.captures, 16, settings={"iteration": 3})


def test_captures_come_from_folders_and_move_into_the_meshs_space(square):
    asset = mistyle.read_mesh(square / "square.obj")
    captures = mistyle.read_captures(square / "shots", asset)
    assert [c.name for c in captures.cameras] == [
        c.name for c in mistyle.read_cameras(square / "shots" / "camera.json")
    ]
    assert captures.lights[0] == mistyle.read_lights(square / "shots")
    assert captures.load(0)[0].shape == (*captures.cameras[0].size, 3)
    views = mistyle.read_views(square / "shots")
    assert [v.camera.name for v in views] == [c.name for c in captures.cameras]


def test_cameras_in_the_files_own_units_are_moved(tmp_path):
    (tmp_path / "tri.obj").write_text("v 10 0 0\nv 12 0 0\nv 10 2 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    asset = mistyle.read_mesh(tmp_path / "tri.obj")
    matrix = [[1, 0, 0, 11], [0, 1, 0, 1], [0, 0, 1, 8], [0, 0, 0, 1]]
    frame = {"file_path": "a.png", "transform_matrix": matrix, "fl_x": 20, "w": 8, "h": 8}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    (tmp_path / "lights.json").write_text(json.dumps({"lights": [{"type": "ambient", "radiance": [1, 1, 1]}]}))
    from mistyle.io.images.write import write_png

    write_png(tmp_path / "a.png", np.full((8, 8, 3), 0.5, np.float32))
    own, moved = (mistyle.read_captures(tmp_path, given).cameras[0].position for given in (None, asset))
    np.testing.assert_allclose(own, [11, 1, 8])
    np.testing.assert_allclose(moved, (asset.source.work_from_user @ [11, 1, 8, 1])[:3], atol=1e-6)
    assert np.linalg.norm(moved) < 0.8 * np.linalg.norm(own)


def test_compare_takes_arrays_views_and_files(tmp_path, rng):
    from mistyle.core.image import srgb_from_linear
    from mistyle.io.images.write import write_png

    reference = rng.random((24, 32, 3)).astype(np.float32)
    test = np.clip(reference + 0.1, 0, 1).astype(np.float32)
    write_png(tmp_path / "a.png", srgb_from_linear(reference), bits=16)
    apart = mistyle.compare(reference, test)
    again = mistyle.compare(tmp_path / "a.png", test)
    assert apart["psnr"] == pytest.approx(again["psnr"], abs=0.01) and "hdr_flip" not in apart and "lpips" not in apart
    np.testing.assert_allclose(mistyle.read_picture(tmp_path / "a.png"), reference, atol=1e-3)
    assert set(apart) == set(apart.definitions) and apart.maps["flip"].shape == (24, 32)
    assert "hdr_flip" in mistyle.compare(reference, test + 1)
    shown = apart._repr_html_()
    assert "ΔE00" in shown and "data:image/webp" in shown


def test_compare_looks_inside_the_mask_and_leaves_out_what_is_no_number(rng):
    reference = rng.random((16, 16, 3)).astype(np.float32)
    test = reference.copy()
    test[:8] += 0.5
    test[8, 0] = np.nan
    mask = np.zeros((16, 16), bool)
    mask[8:] = True
    apart = mistyle.compare(reference, test, mask, metrics=("psnr", "relmse"))
    assert apart["psnr"] == np.inf and apart["relmse"] == 0 and apart.pixels == 127 and apart.bad["nan_test"] == 1
    assert "nan_test" in apart._repr_html_()
    rough = mistyle.compare(np.zeros((4, 4)), np.full((4, 4), 0.25), kind="data")
    assert dict(rough) == {"rmse": 0.25, "mae": 0.25, "max_error": 0.25, "differing": 1.0}
    turned = mistyle.compare(np.eye(3)[None], np.eye(3)[[1, 2, 0]][None], kind="data")
    assert turned["angle"] == pytest.approx(90)


def test_what_compare_refuses():
    grey = np.zeros((4, 4, 3), np.float32)
    with pytest.raises(UsageError, match="'rmse'.*psnr"):
        mistyle.compare(grey, grey, metrics=("rmse",))
    with pytest.raises(InputRefused, match="expected 4 x 4"):
        mistyle.compare(grey, np.zeros((4, 5, 3), np.float32))
    with pytest.raises(InputRefused, match=r"reference: found an array of the shape \(4, 4, 1\).*kind='data'"):
        mistyle.compare(grey[..., 0], grey)


def test_bake_and_lookdev_write_and_show_themselves(square, tmp_path):
    baked = mistyle.bake(square / "square.obj", square / "shots", tmp_path / "baked", name="tile", atlas={"size": 32})
    assert baked.asset == tmp_path / "baked" / "tile.glb" and baked.asset.is_file() and json.dumps(baked)
    with pytest.raises(UsageError, match="size"):
        mistyle.bake(square / "square.obj", square / "shots", tmp_path, atlas={"size": 3})
    sheet = mistyle.lookdev(baked.asset, tmp_path / "sheet", size=64, spp=1, date="today")
    assert isinstance(sheet, dict) and Path(sheet["sheet"]).is_file() and sheet.figures == {}
    assert "data:image/webp" in sheet._repr_html_() and "tile.glb" in baked._repr_html_()
    with pytest.raises(UsageError, match="did you mean"):
        mistyle.lookdev(baked.asset, tmp_path / "sheet", sizes=64)  # pyright: ignore


def test_results_escape_what_they_show():
    said = mistyle.JobResult(name="<b>", asset="<script>", figures={"<x>": 1.0}, notes=["a < b"])._repr_html_()
    assert "<b>" not in said and "<script>" not in said and "<x>" not in said and "a &lt; b" in said
    assert "<u>" not in html.thumbnails({"<u>": np.zeros((2, 2), np.float32)})


def test_a_fitted_scene_shows_itself():
    device.use()
    scene = flat(cameras=CAMERAS[:1])
    fitted = mistyle.fit_scene(scene, COLOUR, references=references(scene, 4), iterations=2, spp=2)
    shown = fitted._repr_html_()
    assert COLOUR in shown and "psnr_after" in shown and isinstance(fitted, mistyle.SceneFit)


def test_a_gallery_is_one_png(tmp_path, rng):
    from PIL import Image

    rows = {"maps": mistyle.flat_maps(4), "pictures": [rng.random((4, 8, 3)), np.zeros((8, 8), np.float32)]}
    made = mistyle.gallery(rows, 64, names=("a", "b"))
    assert made._repr_png_().startswith(b"\x89PNG")
    assert Image.open(made.save(tmp_path / "g.png")).size == made.pixels.shape[1::-1]
    wide = mistyle.gallery({"maps": rows["maps"]}, 64).pixels
    assert wide.shape[1] == made.pixels.shape[1] and len(wide) < len(made.pixels)


@pytest.mark.timeout(900)
def test_the_notebook_runs_and_its_stored_outputs_are_those(tmp_path):
    """What it shows has the same kinds of output as what is stored; the fit is as good as its text says."""
    stored = json.loads(NOTEBOOK.read_text("utf-8"))
    ran, names = execute(NOTEBOOK)
    code = [cell for cell in stored["cells"] if cell["cell_type"] == "code"]
    kinds = [
        [[output["output_type"], *sorted(output.get("data", ()))] for output in cell["outputs"]]
        for notebook in (stored, ran)
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]
    assert kinds[: len(code)] == kinds[len(code) :] and any("image/png" in o for cell in kinds for o in cell)
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    lines = [line for cell in code for line in "".join(cell["source"]).splitlines() if line.strip()]
    assert len(lines) <= 40 and NOTEBOOK.stat().st_size <= 300_000
    truth, fit, relit = (names[name] for name in ("truth", "fit", "relit"))
    seen = fit.seen[0] > 0
    assert mistyle.compare(truth.albedo, fit.maps[0].albedo, seen, metrics=("psnr",))["psnr"] > 34
    assert mistyle.compare(truth.normal, fit.maps[0].normal, seen, kind="data")["angle"] < 2
    assert mistyle.compare(relit[2], relit[1], metrics=("psnr",))["psnr"] > 36
    assert names["loss"].item() < 0.002
