"""Models: where they are found, what is refused, fetching from a server of our own, conversion, single checkpoints."""

import hashlib
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from safetensors.torch import load_file, save_file

from mistyle.cli.main import main
from mistyle.core.errors import EnvironmentMissing, InputRefused, UsageError
from mistyle.stylization.diffusion.settings import ModelSettings
from mistyle.stylization.models import check as models_check
from mistyle.stylization.models import fetch as models_fetch
from mistyle.stylization.models import folder as models
from mistyle.stylization.models import load as models_load
from mistyle.stylization.models.catalogue import ENCODER
from tests.support import tiny_models
from tests.support.helpers import ROOT

torch.set_num_threads(1)


class Hub(BaseHTTPRequestHandler):
    """As much of the hub as huggingface_hub asks for; `files` are served, large ones up to byte `cut`."""

    files: dict[str, bytes] = {}
    asked: list[tuple[str, str]] = []
    cut = 0
    false_tags = False

    def log_message(self, *arguments) -> None:
        pass

    def do_HEAD(self) -> None:
        self.answer(body=False)

    def do_GET(self) -> None:
        self.answer(body=True)

    def answer(self, body: bool) -> None:
        path = self.path.split("?")[0]
        if path.startswith("/api/models/"):
            info: object = {"id": "x/y", "sha": "c" * 40, "siblings": [{"rfilename": n} for n in self.files]}
            if "/tree/" in path:
                info = [{"type": "file", "path": n, "size": len(d), "oid": "0" * 40} for n, d in self.files.items()]
            text = json.dumps(info).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)
            return
        found = re.fullmatch(r"/[^/]+/[^/]+/resolve/[^/]+/(.+)", path)
        if not found or found[1] not in self.files:
            self.send_error(404)
            return
        data = self.files[found[1]]
        if body:
            self.asked.append((found[1], self.headers.get("Range", "")))
        span = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        start = int(span[1]) if span else 0
        tag = hashlib.sha256(b"other" if self.false_tags else data).hexdigest()
        tag = tag if len(data) > 100_000 else tag[:40]  # only large files are tagged by their sha256
        self.send_response(206 if start else 200)
        for name, value in (
            ("ETag", f'"{tag}"'),
            ("X-Repo-Commit", "c" * 40),
            ("X-Linked-Etag", f'"{tag}"'),
            ("X-Linked-Size", str(len(data))),
            ("Accept-Ranges", "bytes"),
            ("Content-Length", str(len(data) - start)),
            ("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}"),
        ):
            self.send_header(name, value)
        self.end_headers()
        if body:
            if self.cut and len(data) > 100_000:
                self.wfile.write(data[start : self.cut])
                self.wfile.flush()
                self.connection.close()
            else:
                self.wfile.write(data[start:])


@pytest.fixture
def hub(monkeypatch):
    """A server with the tiny depth ControlNet under the name of its half-precision file."""
    place = tiny_models.folder() / "depth"
    Hub.files = {
        "config.json": (place / "config.json").read_bytes(),
        "diffusion_pytorch_model.fp16.safetensors": (place / "diffusion_pytorch_model.safetensors").read_bytes(),
        "unwanted.bin": b"x" * 1000,
    }
    Hub.asked, Hub.cut, Hub.false_tags = [], 0, False
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def fetch(
    endpoint: str, folder: Path, *names: str, allow: bool = True, offline: str = "0"
) -> subprocess.CompletedProcess:
    """`mistyle models fetch` as a user runs it: huggingface_hub reads HF_ENDPOINT when it is imported."""
    environment = os.environ | {
        "HF_ENDPOINT": endpoint,
        "HF_HUB_OFFLINE": offline,
        "HF_HOME": str(folder.parent / "home"),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "NO_PROXY": "127.0.0.1",
    }
    words = ["models", "fetch", *names, "--models", str(folder), *(["--allow-download"] if allow else [])]
    # What the test's server holds is not what is published under these names.
    program = (
        "import sys; from dataclasses import replace; from mistyle.cli.main import main; "
        "from mistyle.stylization.models.catalogue import MODELS; "
        "MODELS.update({name: replace(model, sha256={}) for name, model in MODELS.items()}); "
        "sys.exit(main(sys.argv[1:]))"
    )
    return subprocess.run(
        [sys.executable, "-c", program, *words], env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120
    )


def test_fetching_writes_the_layout_and_the_lock(hub, tmp_path):
    folder = tmp_path / "models"
    done = fetch(hub, folder, "depth")
    assert done.returncode == 0, done.stderr
    lock = json.loads((folder / models.LOCK).read_text())["depth"]
    assert lock["revision"] == models.MODELS["depth"].revision
    assert set(lock["files"]) == {"config.json", "diffusion_pytorch_model.fp16.safetensors"}, "only what is wanted"
    assert models.find("depth", folder) == folder / "depth" and models.variant(folder / "depth") == "fp16"
    row = next(r for r in models_fetch.listing(folder) if r["name"] == "depth")
    assert row["found"] == str(folder / "depth") and len(row["sha256"]) == 1
    file = folder / "depth" / "diffusion_pytorch_model.fp16.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    with pytest.raises(
        EnvironmentMissing, match=r"sha256 is .*, expected .* recorded when the file was added.*mistyle models fetch"
    ):
        models.find("depth", folder)


def test_a_broken_download_goes_on_where_it_stopped(hub, tmp_path):
    # The client writes in pieces of 10 MB.
    Hub.files["diffusion_pytorch_model.fp16.safetensors"] = safetensors.torch.save({"a": torch.randn(6, 1_000_000)})
    Hub.cut = 15_000_000
    first = fetch(hub, tmp_path / "models", "depth")
    assert first.returncode == 4 and "rerun to resume" in first.stderr, first.stderr
    Hub.cut, Hub.asked = 0, []
    second = fetch(hub, tmp_path / "models", "depth")
    assert second.returncode == 0, second.stderr
    starts = [span for name, span in Hub.asked if name.endswith(".safetensors")]
    assert starts == ["bytes=10485760-"], Hub.asked
    place = models.find("depth", tmp_path / "models")
    name = "diffusion_pytorch_model.fp16.safetensors"
    assert (place / name).read_bytes() == Hub.files[name] and not (place / models_fetch.PARTIAL).exists()


def test_a_repository_cannot_write_elsewhere(tmp_path):
    with pytest.raises(EnvironmentMissing, match="outside its own folder"):
        models_fetch._inside(tmp_path / "models", "../x.json")


def test_a_wrong_hash_is_refused_and_the_file_removed(hub, tmp_path):
    Hub.false_tags = True
    done = fetch(hub, tmp_path / "models", "depth")
    assert done.returncode == 4 and "the file was removed" in done.stderr, done.stderr
    assert not list((tmp_path / "models" / "depth").glob("*.safetensors"))


def test_a_published_pickle_becomes_safetensors_on_the_way(hub, tmp_path):
    state = load_file(tiny_models.folder() / "position" / "diffusion_pytorch_model.safetensors")
    torch.save(state, tmp_path / "x.bin")
    Hub.files = {
        "config.json": (tiny_models.folder() / "position" / "config.json").read_bytes(),
        "diffusion_pytorch_model.bin": (tmp_path / "x.bin").read_bytes(),
    }
    done = fetch(hub, tmp_path / "models", "position")
    assert done.returncode == 0, done.stderr
    lock = models.read_lock(tmp_path / "models")["position"]
    assert lock["revision"] == "c" * 40, "no commit was published: the one that was fetched is noted"
    assert models_fetch._commit(models.MODELS["position"], "d" * 40) == "d" * 40
    found = load_file(models.find("position", tmp_path / "models") / "diffusion_pytorch_model.safetensors")
    assert set(found) == set(state) and all(torch.equal(found[k], state[k]) for k in state)


def test_nothing_is_fetched_unasked(hub, tmp_path):
    done = fetch(hub, tmp_path / "models", "depth", allow=False)
    assert done.returncode == 2 and "--allow-download" in done.stderr and "2.5 GB" in done.stderr
    assert not Hub.asked and not (tmp_path / "models").exists()
    assert main(["models", "fetch", "nothing", "--models", str(tmp_path)]) == 2
    assert main(["models", "fetch", "depth"]) == 2


def test_a_hub_that_may_not_be_asked_is_one_sentence(tmp_path):
    done = fetch("http://127.0.0.1:9", tmp_path / "models", "canny", offline="1")
    assert done.returncode == 4 and "could not be fetched" in done.stderr and "Traceback" not in done.stderr


def test_the_list_says_what_is_where(capsys):
    assert main(["models", "--models", str(tiny_models.folder())]) == 0
    text = capsys.readouterr().out
    for model in models.MODELS.values():
        assert all(part in text for part in (model.name, model.repo, model.revision, model.licence, model.purpose))
    assert "289b45f16d043d0bf542e45831f971dcdaabe18b656f11e86d9dfba7e9ee3369" in text
    assert main(["models", "--json", "--models", str(tiny_models.folder())]) == 0
    rows = json.loads(capsys.readouterr().out)["models"]
    assert all(row["found"] for row in rows) and len(rows) == len(models.MODELS)


def test_the_cache_serves_where_no_folder_is_given(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    depth = models.MODELS["depth"]
    snapshot = tmp_path / "models--diffusers--controlnet-depth-sdxl-1.0" / "snapshots" / depth.revision
    snapshot.parent.mkdir(parents=True)
    snapshot.symlink_to(tiny_models.folder() / "depth")
    assert models.find("depth", None) == snapshot
    assert models.find("depth", tiny_models.folder()) == tiny_models.folder() / "depth", "the folder comes first"
    main_ref = tmp_path / "models--diffusers--controlnet-canny-sdxl-1.0"
    (main_ref / "refs").mkdir(parents=True)
    (main_ref / "refs" / "main").write_text("abc")
    (main_ref / "snapshots").mkdir()
    (main_ref / "snapshots" / "abc").symlink_to(tiny_models.folder() / "canny")
    assert models.find("canny", None) == main_ref / "snapshots" / "abc"


def test_files_copied_by_hand_are_compared_with_the_published_ones(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "models"
    shutil.copytree(tiny_models.folder() / "sdxl", folder / "sdxl")  # without the lock beside it
    words = r"/vae/\w+.safetensors: sha256 is \w+, expected 1598f3d2\w+ as in .*mistyle models adopt sdxl"
    with pytest.raises(EnvironmentMissing, match=words):
        models.find("sdxl", folder)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    snapshot = tmp_path / "cache/models--stabilityai--stable-diffusion-xl-base-1.0/snapshots"
    snapshot.mkdir(parents=True)
    (snapshot / models.MODELS["sdxl"].revision).symlink_to(folder / "sdxl")
    with pytest.raises(EnvironmentMissing, match=words):
        models.find("sdxl", None)
    assert main(["models", "adopt", "sdxl", "--models", str(folder)]) == 0
    assert models.find("sdxl", folder) == folder / "sdxl"
    assert main(["models", "adopt", "depth", "--models", str(folder)]) == 4
    assert "depth is missing" in capsys.readouterr().err
    published = hashlib.sha256((folder / "sdxl/vae/diffusion_pytorch_model.safetensors").read_bytes()).hexdigest()
    pinned = replace(models.MODELS["sdxl"], sha256={"vae/diffusion_pytorch_model.safetensors": published})
    monkeypatch.setitem(models.MODELS, "sdxl", pinned)
    (folder / models.LOCK).unlink()
    assert models.find("sdxl", folder) == folder / "sdxl"
    assert list(models.read_lock(folder)["sdxl"]["files"]) == ["vae/diffusion_pytorch_model.safetensors"]
    (folder / "sdxl/vae/diffusion_pytorch_model.safetensors").write_bytes(b"x")
    with pytest.raises(EnvironmentMissing, match="has changed since"):
        models.find("sdxl", folder)


def test_shards_and_variants_are_found(tmp_path):
    state = load_file(tiny_models.folder() / "depth" / "diffusion_pytorch_model.safetensors")
    names = sorted(state)
    table = {}
    for k, part in enumerate((names[: len(names) // 2], names[len(names) // 2 :])):
        file = f"diffusion_pytorch_model-0000{k + 1}-of-00002.safetensors"
        save_file({n: state[n] for n in part}, tmp_path / file)
        table |= dict.fromkeys(part, file)
    index = {"metadata": {}, "weight_map": table}
    (tmp_path / "diffusion_pytorch_model.safetensors.index.json").write_text(json.dumps(index))
    (tmp_path / "config.json").write_bytes((tiny_models.folder() / "depth" / "config.json").read_bytes())
    assert len(models.weights(tmp_path)) == 2
    assert models_check.numbers(models.weights(tmp_path)) == sum(v.numel() for v in state.values())
    from diffusers import ControlNetModel

    made = models_load.network(ControlNetModel, tmp_path, torch.float32)
    assert all(torch.equal(v, state[k]) for k, v in made.state_dict().items())
    next(tmp_path.glob("*00002-of*")).unlink()
    assert models.weights(tmp_path) == []


def test_pickles_are_not_loaded_but_converted_once(tmp_path, capsys):
    folder = tiny_models.copy_without(tmp_path / "models")
    file = folder / "position" / "diffusion_pytorch_model.safetensors"
    state = load_file(file)
    file.unlink()
    torch.save(state, file.with_suffix(".bin"))
    with pytest.raises(EnvironmentMissing, match=r"is a pickle.*mistyle models convert position"):
        models.find("position", folder)
    assert main(["models", "convert", "position", str(folder / "position"), "--models", str(folder)]) == 0
    assert models.find("position", folder) == folder / "position"
    assert all(torch.equal(v, state[k]) for k, v in load_file(file).items())


class Evil:
    def __reduce__(self):
        return os.system, ("touch /tmp/mistyle-evil",)


@pytest.mark.parametrize("kind", ["code", "code in torch", "noise", "no table"])
def test_pickles_with_anything_but_tensors_are_refused(tmp_path, kind):
    path = tmp_path / "x.bin"
    if kind == "code":
        path.write_bytes(pickle.dumps(Evil()))
    elif kind == "code in torch":
        torch.save({"a": Evil()}, path)
    elif kind == "noise":
        path.write_bytes(os.urandom(500))
    else:
        torch.save([torch.zeros(2)], path)
    with pytest.raises(InputRefused):
        models_fetch.convert(path, tmp_path / "out")
    assert not Path("/tmp/mistyle-evil").exists() and not (tmp_path / "out").exists()


def test_no_code_of_others_is_ever_run():
    """No place where remote code is trusted, pickles are allowed or watermarks are stamped into textures."""
    for path in (ROOT / "mistyle" / "stylization").rglob("*.py"):
        text = path.read_text("utf-8")
        assert "trust_remote_code" not in text and "weights_only=False" not in text, path
        for found in re.finditer(r"StableDiffusionXL\w*Pipeline(\.from_single_file)?\(", text):
            call = text[found.start() : found.start() + 250]
            assert "add_watermarker=False" in call, (path, call)


def test_an_unknown_device_is_refused():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(EnvironmentMissing, match="torch finds no such device"):
        models_load.device_of(ModelSettings(device="cuda"))


def test_pictures_reach_clip_whole(rng):
    """A wide picture is drawn out to the square: its left and right borders count."""
    from transformers import CLIPVisionModelWithProjection

    place = tiny_models.folder() / "ip-adapter" / ENCODER
    encoder = models_load.network(CLIPVisionModelWithProjection, place, torch.float32)
    wide = rng.random((32, 96, 3)).astype(np.float32)
    other = wide.copy()
    other[:, :16] = 0
    a, b = (models_load.image_embedding(encoder, p) for p in (wide, other))
    assert a.shape == (1, 32) and (a - b).abs().max() > 1e-4
    from transformers import CLIPImageProcessor

    square = np.round(rng.random((32, 32, 3)) * 255).astype(np.uint8)
    processor = CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32})
    with torch.no_grad():
        theirs = encoder(processor(square, return_tensors="pt").pixel_values).image_embeds
    ours = models_load.image_embedding(encoder, (square / 255).astype(np.float32))
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


def test_single_files_are_found_by_their_models_names(tmp_path, monkeypatch, capsys):
    from mistyle.measure.features import load_features
    from mistyle.stylization.pipeline.generative import fit_settings, named
    from mistyle.stylization.settings import resolve

    folder = tiny_models.folder()
    for name, file in (("vgg19", "vgg19-dcbb9e9d.pth"), ("birefnet", "BiRefNet-general-epoch_244.onnx")):
        assert models.file(name, folder) == folder / name / file
    said = {"models": {"folder": str(folder)}, "fit": {"features": "vgg19"}, "sweep": {"segmenter": "birefnet"}}
    settings = resolve("standard", None, said, {})
    found = fit_settings(settings)
    assert len(load_features(found.features)(torch.rand(1, 3, 32, 32))) == 3
    assert len(load_features(models.file("vgg19-normalised", folder))(torch.rand(1, 3, 32, 32))) == 3
    assert named(settings, settings.sweep.segmenter) == folder / "birefnet" / "BiRefNet-general-epoch_244.onnx"
    assert found.painted == "without-light"
    assert fit_settings(resolve("standard", None, said | {"stylizer": "diffusion"}, {})).painted == "with-light"
    # Torchvision's own file is known by eight digits of its hash, BiRefNet's by all of them.
    (tmp_path / "vgg19").mkdir()
    shutil.copy(folder / "vgg19" / "vgg19-dcbb9e9d.pth", tmp_path / "vgg19")
    with pytest.raises(EnvironmentMissing, match=r"expected dcbb9e9d as in torchvision.*models adopt vgg19"):
        models.file("vgg19", tmp_path)
    digits = hashlib.sha256((tmp_path / "vgg19" / "vgg19-dcbb9e9d.pth").read_bytes()).hexdigest()[:8]
    known = replace(models.MODELS["vgg19"], sha256={"vgg19-dcbb9e9d.pth": digits})
    monkeypatch.setitem(models.MODELS, "vgg19", known)
    assert models.file("vgg19", tmp_path).parent == tmp_path / "vgg19"
    with pytest.raises(EnvironmentMissing, match=r"download https://.*epoch_244.onnx and put it at .*birefnet"):
        models.file("birefnet", tmp_path)
    with pytest.raises(EnvironmentMissing, match=r"no --models DIR was given; download https"):
        models.file("birefnet", None)
    assert main(["models", "fetch", "birefnet", "--models", str(tmp_path), "--allow-download"]) == 2
    assert "is not on the hub: download https" in capsys.readouterr().err


def test_the_paper_preset_names_what_it_lacks_and_what_needs_nothing(tmp_path, monkeypatch):
    from mistyle.stylization.pipeline.generative import check
    from mistyle.stylization.settings import resolve

    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(EnvironmentMissing, match=r"vgg19.* --preset fine"):
        check(resolve("paper", None, {}, {}), print)
    check(resolve("fine", None, {}, {}), print)


def test_names_that_are_not_models_are_refused():
    with pytest.raises(UsageError, match="choose one of sdxl"):
        models.get("sdxxl")


def test_a_single_checkpoint_loads_like_the_folder(tmp_path):
    """SDXL as one file in its original layout, with the configurations of the folder, gives the same networks."""
    from tests.support.original_layout import single_file

    place = tmp_path / "models" / "sdxl"
    torch.manual_seed(0)
    tiny_models.sdxl(place, second=48)  # encoders of one width cannot be told apart in a single file
    tensors = single_file(place)
    save_file(tensors, tmp_path / "finetune.safetensors")
    models_check.checkpoint(tmp_path / "finetune.safetensors", place)
    ours = models_load.base_parts(place, "sdxl", torch.float32)
    theirs = models_load.base_parts(place, "sdxl", torch.float32, tmp_path / "finetune.safetensors")
    assert set(ours) == set(theirs) and theirs["scheduler"].config.timestep_spacing == "trailing"
    for name in ("unet", "vae", "text_encoder", "text_encoder_2"):
        a, b = ours[name].state_dict(), theirs[name].state_dict()
        assert set(a) == set(b)
        assert all(torch.equal(v, b[k]) for k, v in a.items() if not k.endswith("position_ids")), name
        assert not any(p.requires_grad for p in theirs[name].parameters())
    for network in ("unet", "vae", "text_encoder", "text_encoder_2"):
        for file in (place / network).glob("*.safetensors"):
            file.unlink()
    from mistyle.stylization.diffusion import lora_files as consislora_make

    settings = ModelSettings(folder=tmp_path / "models", checkpoint=tmp_path / "finetune.safetensors", device="cpu")
    trained = consislora_make.trainer(settings)
    assert trained.unet.config.cross_attention_dim == 80, "the folder's weights are not needed"
    (place / "model_index.json").unlink()
    with pytest.raises(EnvironmentMissing, match="lacks model_index.json"):
        models_check.checkpoint(tmp_path / "finetune.safetensors", place)
    nine = tensors | {"model.diffusion_model.input_blocks.0.0.weight": torch.zeros(32, 9, 3, 3)}
    save_file(nine, tmp_path / "nine.safetensors")
    (place / "model_index.json").write_text("{}")
    with pytest.raises(EnvironmentMissing, match="9 channels, expected 4"):
        models_check.checkpoint(tmp_path / "nine.safetensors", place)


def test_other_weights_of_the_same_shape_are_other_networks(tmp_path):
    """What is kept under a model's fingerprint must not serve another: a changed number changes it."""
    paths = [tmp_path / f"{k}" / "model.safetensors" for k in range(3)]
    values = [torch.zeros(3000), torch.zeros(3000), torch.zeros(3000)]
    values[1][1500] = 1
    for path, value in zip(paths, values, strict=True):
        path.parent.mkdir()
        save_file({"a": value}, path)
    prints = [models.fingerprint([p]) for p in paths]
    assert prints[0] == prints[2] != prints[1]
    large = tmp_path / "large"
    large.write_bytes(bytes(10_000_000))
    before = models.fingerprint([large])
    with open(large, "r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"x")
    assert models.fingerprint([large]) != before
