"""The border: what strangers wrote is opened and decoded in the reader process, and whatever happens there, the job
goes on with one sentence."""

import ast
import io
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mistyle.core.errors import InputRefused, MistyleError
from mistyle.io.images.write import write_exr, write_png
from mistyle.io.meshes.parsed_mesh import RawMap, Textures, Tile
from mistyle.io.read import read_exr, read_json, read_npy, read_picture, read_size, read_toml, read_yaml
from mistyle.io.read_mesh import read_mesh
from mistyle.io.sandbox import bounds, reader_process, rpc_codec, shared_copy
from mistyle.process import weights
from tests.support.helpers import ROOT, data

posix = os.name == "posix"

# --- what the source says ---

# Calls that decode a file or bytes of a format, and where they may stand. Everything in DECODERS runs in the reader
# process; the others read what mistyle itself wrote, or are child processes of their own.
CALLS = {
    *(
        ("Image", "open"),
        ("cv2", "imread"),
        ("cv2", "imdecode"),
        ("OpenEXR", "File"),
        ("np", "load"),
        ("np", "fromfile"),
        ("rawpy", "imread"),
    ),
    *(("torch", "load"), ("pickle", "load"), ("pickle", "loads"), ("yaml", "safe_load"), ("library", "safe_load")),
    *(("yaml", "load"), ("tomllib", "load"), ("tomllib", "loads"), ("mi", "load_file"), ("np", "memmap")),
    *(("ElementTree", "parse"), ("ElementTree", "fromstring"), ("zipfile", "ZipFile"), ("np", "loadtxt")),
    *(
        ("trimesh", "load"),
        ("imageio", "imread"),
        ("Stage", "Open"),
        ("json", "load"),
        ("xatlas", "parse_mesh"),
        ("mx", "readFromXmlString"),
    ),
}
DECODERS = {
    *(
        "io/images/read",
        "io/images/hdr",
        "io/images/float_tiff",
        "io/images/layers",
        "io/images/raw",
        "io/meshes/obj_read",
        "io/meshes/stl_off_read",
        "io/gltf/read",
    ),
    *("io/gltf/check", "io/gltf/materials", "io/cameras/colmap", "io/cameras/metashape", "io/cameras/realityscan"),
    *("io/sandbox/references", "io/sandbox/reader_tasks"),
    *("io/usd/read", "io/usd/layers", "io/usd/materials", "io/meshes/mtl_read", "io/meshes/ply_read"),
    *("io/gltf/pose", "io/usd/stage", "io/usd/mesh", "io/usd/mtlx"),
}
ALLOWED = {
    "setup/environment": "pyproject.toml of the clone",
    "core/light": "scene files that come with mistyle",
    "process/memory": "arrays that mistyle wrote into a run's folder",
    "geometry/unwrap": "what its own child wrote into a folder of its own",
    "geometry/xatlas_worker": "what its parent wrote into a folder of its own",
    "process/weights": "safetensors, mapped in place after their header was checked",
    "process/weights_worker": "a child process of its own: weights that are no safetensors",
    "io/images/write": "writes EXR",
    "io/usd/write": "the package that it has just written",
    "io/usd/look": "the USD file that the reader process has read in the same run, to lay materials over it",
    "measure/pictures/flip_bands": "what its parent wrote into a folder of its own",
    "render/external/cycles_worker": "the job that mistyle wrote for it",
    "render/external/mitsuba_worker": "the job that mistyle wrote for it, or the user's scene, trusted like code",
    "render/lookdev/scenes": "the user's scene (--scene), trusted like code",
    "render/mitsuba/scene": "the user's scene (--scene), trusted like code",
    "batch/page": "a report's own picture",
    "render/external/blender_worker": "the job that mistyle wrote for it",
    "jobs/settings": "a word of the user's own command line",
    "deliver/verify_checks": "pictures that mistyle has just written, decoded by others on purpose",
    "deliver/verify_surfaces": "models that a list of mistyle's names, opened by others on purpose",
    "stylization/mvst/sweep": "views that a run kept in its own folder",
}
# Names of decoding modules that others may import: records, and what only looks at paths or checked trees.
TYPES = {"LayeredPicture", "Layer", "Window", "BEAUTY", "find_model", "models_below", "data_uri"}
TYPES |= {"frame_of", "picture_of"}  # arithmetic on what was decoded


@cache
def modules() -> dict[str, ast.Module]:
    paths = sorted((ROOT / "mistyle").rglob("*.py"))
    return {p.relative_to(ROOT / "mistyle").with_suffix("").as_posix(): ast.parse(p.read_text("utf-8")) for p in paths}


def decoding(tree: ast.Module) -> list[str]:
    """Calls of a module that decode, as "Image.open (line 3)"."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = node.func.value
            name = owner.id if isinstance(owner, ast.Name) else owner.attr if isinstance(owner, ast.Attribute) else ""
            if (name, node.func.attr) in CALLS:
                found.append(f"{name}.{node.func.attr} (line {node.lineno})")
    return found


def borrowed(tree: ast.Module) -> list[str]:
    """Functions of decoding modules that a module imports."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            place = node.module.removeprefix("mistyle.").replace(".", "/")
            for alias in node.names:
                if place in DECODERS and alias.name not in TYPES:
                    found.append(f"{alias.name} of {place}")
                if f"{place}/{alias.name}" in DECODERS:
                    found.append(f"{place}/{alias.name}")
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.removeprefix("mistyle.").replace(".", "/") in DECODERS]
    return found


def test_strangers_files_are_decoded_behind_the_border_only():
    wrong = [
        f"{name}: {call}"
        for name, tree in modules().items()
        if name not in DECODERS | ALLOWED.keys()
        for call in decoding(tree)
    ]
    assert not wrong, "\n".join(wrong)


def test_decoders_are_reached_through_the_reader_process_only():
    wrong = [
        f"{name} imports {what}"
        for name, tree in modules().items()
        if name not in DECODERS
        for what in borrowed(tree)
        # The child itself, and the writers of layers over a USD file, and of moved vertices of a glTF file, that the
        # child has read and checked before.
        if name not in {"io/sandbox/reader_child", "io/usd/look", "io/gltf/displaced"}
    ]
    assert not wrong, "\n".join(wrong)


def test_the_rules_can_be_broken():
    assert decoding(ast.parse("from PIL import Image\ndef f(p):\n    return Image.open(p)"))
    assert decoding(ast.parse("import numpy as np\nnp.load('a.npy')")) == ["np.load (line 2)"]
    assert borrowed(ast.parse("from mistyle.io.images.read import read_picture"))
    assert borrowed(ast.parse("from mistyle.io.images import hdr")) and borrowed(
        ast.parse("import mistyle.io.images.hdr")
    )
    assert not borrowed(ast.parse("from mistyle.io.images.layers import LayeredPicture"))


def test_what_is_excused_is_there():
    there = modules()
    assert DECODERS | ALLOWED.keys() <= there.keys(), (DECODERS | ALLOWED.keys()) - there.keys()
    assert not [name for name in ALLOWED if not decoding(there[name])]


def test_the_reader_loads_no_renderer_and_no_torch():
    """It starts in well under a second, and a hostile file meets only decoders."""
    source = "import sys, mistyle.io.sandbox.reader_tasks; print(sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT, check=True)
    loaded = set(ast.literal_eval(done.stdout))
    assert not loaded & {"mitsuba", "drjit", "torch", "diffusers", "transformers", "ray", "jinja2", "socketserver"}


# --- what the process does ---


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    write_png(tmp_path / "a.png", np.random.default_rng(0).random((5, 7, 3)).astype(np.float32))
    return tmp_path / "a.png"


def child() -> int:
    """The number of the present reader process."""
    reader = reader_process._reader
    assert reader is not None
    return reader.process.pid


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_one_child_serves_file_after_file(picture: Path):
    first = read_picture(picture)
    number = child()
    assert read_size(picture) == (5, 7) and np.array_equal(read_picture(picture).rgb, first.rgb)
    with pytest.raises(InputRefused, match="found nothing"):
        read_picture(picture.with_name("b.png"))
    assert child() == number and number != os.getpid()
    first.rgb[0, 0] = 2  # arrays are this process's own, and can be written to


def test_relative_paths_follow_the_working_folder(picture: Path, monkeypatch: pytest.MonkeyPatch):
    read_size(picture)
    monkeypatch.chdir(picture.parent)
    assert read_size(Path("a.png")) == (5, 7)


@pytest.mark.skipif(not posix, reason="signals")
@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGKILL", "SIGXCPU"])
def test_a_crash_is_a_refusal_and_the_next_file_gets_a_new_child(name: str, picture: Path):
    read_size(picture)
    number = child()
    os.kill(number, signal.SIGSTOP)  # so that it dies amid the request
    threading.Timer(0.2, lambda: (os.kill(number, getattr(signal, name)), os.kill(number, signal.SIGCONT))).start()
    words = "processor time" if name == "SIGXCPU" else name
    with pytest.raises(InputRefused, match=words) as refusal:
        read_picture(picture)
    assert str(picture) in str(refusal.value) and refusal.value.exit_code == 3
    assert len(str(refusal.value).splitlines()) == 1
    assert read_size(picture) == (5, 7) and child() != number and not alive(number)


@pytest.mark.skipif(not posix, reason="signals")
def test_a_hang_is_a_refusal(picture: Path, monkeypatch: pytest.MonkeyPatch):
    read_size(picture)
    number = child()
    monkeypatch.setattr(reader_process, "PATIENCE", 0.5 / reader_process.SECONDS)
    os.kill(number, signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(InputRefused, match="not decoded within"):
        read_picture(picture)
    assert time.monotonic() - start < 5 and not alive(number)
    monkeypatch.undo()
    assert read_size(picture) == (5, 7)


@pytest.mark.skipif(not posix, reason="needs limits on processor time")
def test_a_file_that_takes_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Concave polygons of 500 corners: cutting off ears takes the third power of their number."""
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    star = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (1 + 0.5 * (np.arange(500) % 2))[:, None]
    lines = [f"v {x:.6f} {y:.6f} 0" for x, y in star] + ["f " + " ".join(map(str, range(1, 501)))] * 200
    path = tmp_path / "a.obj"
    path.write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(reader_process, "SECONDS", 0.5)
    monkeypatch.setattr(reader_process, "SECONDS_PER_MIB", 0.0)
    monkeypatch.setattr(reader_process, "PATIENCE", 200.0)
    with pytest.raises(InputRefused, match="processor time"):
        read_mesh(path)


LITTLE = """
import sys
from pathlib import Path
from mistyle.core.errors import InputRefused
from mistyle.io.sandbox import reader_process
from mistyle.io.read import read_picture
path, usual = Path(sys.argv[1]), reader_process.MEMORY
reader_process.MEMORY = 80 << 20
try:
    read_picture(path)
except InputRefused as error:
    assert "a.png: found a file whose decoding takes more than 0.1 GiB" in str(error), error
else:
    sys.exit("it was read")
reader_process.MEMORY = usual
assert read_picture(path).rgb.shape == (3000, 3000, 3)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the address space")
def test_a_file_that_takes_too_much_memory_is_refused(tmp_path: Path):
    """In a process of its own: what ran before in this one decides with how much its reader begins."""
    write_png(tmp_path / "a.png", np.zeros((3000, 3000, 3), np.float32))
    line = [sys.executable, "-c", LITTLE, str(tmp_path / "a.png")]
    done = subprocess.run(line, cwd=Path(__file__).parents[3], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_files_that_a_mesh_names_count_once_memory_runs_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, size in (("a.usda", 10), ("b.usdc", 1_000)):
        (tmp_path / name).write_bytes(b"x" * size)
    sizes: list[int] = []

    def limited(task: str, path: Path, arguments: tuple, size: int) -> str:
        sizes.append(size)
        if size < 1_010:
            raise reader_process.OutOfMemory
        return "read"

    monkeypatch.setattr(reader_process, "_limited", limited)
    assert reader_process.ask("mesh", tmp_path / "a.usda", more=lambda: [tmp_path / "b.usdc"]) == "read"
    assert sizes == [10, 1_010]
    for others in ([], [tmp_path / "a.usda"]):
        with pytest.raises(InputRefused, match="a file whose decoding takes more than"):
            reader_process.ask("mesh", tmp_path / "a.usda", more=lambda others=others: others)


def test_threads_share_the_child(tmp_path: Path):
    for k in range(8):
        write_exr(tmp_path / f"{k}.exr", {"Z": np.full((50, 60), k, np.float32)})
    found: dict[int, list[float]] = {k: [] for k in range(8)}

    def work(k: int) -> None:
        for _ in range(5):
            found[k].append(float(read_exr(tmp_path / f"{k}.exr")["Z"].mean()))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {k: [float(k)] * 5 for k in range(8)}


READ = (
    "from pathlib import Path; from mistyle.io import read; from mistyle.io.sandbox import reader_process; "
    "read.read_size(Path(r'{}'));"
)
READ += "pid = reader_process._reader.process.pid; print(pid, flush=True);"


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
@pytest.mark.parametrize(
    "rest", ["", "import os; os.kill(os.getpid(), 9)", "import os; os._exit(3)", "raise SystemExit(4)", "fork"]
)
def test_no_child_outlives_its_parent(rest: str, picture: Path):
    if rest == "fork":  # a forked copy has a child of its own, and takes nothing from its parent's
        rest = "import os; copy = os.fork();"
        rest += f"read.read_size(Path(r'{picture}')); other = reader_process._reader.process.pid;"
        rest += "same = other == pid; assert same == (copy != 0); copy and os.waitpid(copy, 0)"
    done = subprocess.run([sys.executable, "-c", READ.format(picture) + rest], capture_output=True, text=True, cwd=ROOT)
    assert "Error" not in done.stderr, done.stderr
    number = int(done.stdout.split()[0])
    deadline = time.monotonic() + 5
    while alive(number) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(number)


@pytest.mark.skipif(not posix, reason="needs limits on files")
def test_the_reader_cannot_write(tmp_path: Path):
    source = f"""
import numpy as np, cv2, os, socket, subprocess
from mistyle.io.sandbox import reader_child
reader_child._confine()
place = {str(tmp_path)!r} + "/"
for act in (lambda: open(place + "a", "w"), lambda: os.remove(place + "kept"), lambda: socket.socket(),
            lambda: subprocess.run(["true"]), lambda: os.open(place + "b", os.O_CREAT | os.O_WRONLY),
            lambda: os.rename(place + "kept", place + "c"), lambda: os.system("true")):
    try:
        act()
    except PermissionError:
        continue
    raise SystemExit("was allowed")
try:
    cv2.imwrite(place + "d.png", np.zeros((5, 5, 3), np.uint8))  # native code does not ask Python
except cv2.error:
    pass
"""
    (tmp_path / "kept").write_text("x")
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {p.name: p.stat().st_size for p in tmp_path.iterdir()} in ({"kept": 1}, {"kept": 1, "d.png": 0})


def test_a_reader_that_cannot_start_says_so(picture: Path, monkeypatch: pytest.MonkeyPatch):
    reader_process.stop()
    monkeypatch.setenv("PYTHONHOME", "/nowhere")
    with pytest.raises(MistyleError, match="did not start") as error:
        read_size(picture)
    assert error.value.exit_code == 4
    monkeypatch.undo()
    assert read_size(picture) == (5, 7)


# --- what is sent ---


def through(value):
    """What arrives of a value."""
    sent = bytearray()
    rpc_codec.send(lambda part: sent.extend(part) or len(part), value, extra=1)
    at = 0

    def read(into: memoryview) -> int:
        nonlocal at
        count = min(len(into), len(sent) - at, 1000)
        into[:count] = sent[at : at + count]
        at += count
        return count

    found, head = rpc_codec.receive(read)
    assert head == {"extra": 1} and at == len(sent)
    return found


def test_values_arrive_as_they_were_sent(rng: np.random.Generator):
    shared = rng.random((3, 4))
    textures = Textures({1001: Tile({"albedo": RawMap(shared[:, ::2], transform=np.eye(3))}, ("note",))})
    found = through((1, None, True, "ä", float("inf"), b"\0\1", Path("a"), {3: [shared, shared]}, textures, np.int8(3)))
    assert found[:7] == (1, None, True, "ä", float("inf"), b"\0\1", Path("a")) and found[9] == 3
    a, b = found[7][3]
    assert a is b and np.array_equal(a, shared) and a.flags.writeable
    assert np.array_equal(found[8](1001)[0]["albedo"].values, shared[:, ::2]) and found[8].tiles[1001].notes == (
        "note",
    )
    assert through(np.zeros((0, 3), np.float16)).shape == (0, 3) and through(np.array(2.5)).shape == ()
    assert through(rpc_codec.Json({"a": [1, {"b": None}]})) == {"a": [1, {"b": None}]}
    for value in (object(), np.array([None]), np.array(["a"]), 1j, {1, 2}):
        with pytest.raises(TypeError, match="cannot be sent"):
            through(value)


@pytest.mark.parametrize(
    "head",
    [
        {"value": {"record": "Popen", "fields": {"args": "true"}}, "arrays": []},
        {"value": {"record": "mistyle.core.asset:Picture", "fields": {}}, "arrays": []},
        {"value": {"array": 0}, "arrays": [["|O", [1]]]},
        {"value": {"array": 0}, "arrays": [["<f4", [1 << 40]]]},
        {"value": {"array": 3}, "arrays": []},
        {"value": {"array": 0}, "arrays": [["<f4", [4], 4096]]},
        {"value": {"array": 0}, "arrays": [["<f4", [4], -8]]},
        {"value": {"array": 0}, "arrays": [["<f4", [4], "a"]]},
        {"value": {"a": 1, "b": 2}, "arrays": []},
        {"value": [1], "arrays": []},
        {"arrays": []},
        [],
    ],
)
def test_a_captured_reader_cannot_make_the_job_build_things(head):
    text = json.dumps(head).encode()
    message = len(text).to_bytes(8, "little") + text
    at = 0

    def read(into: memoryview) -> int:
        nonlocal at
        count = min(len(into), len(message) - at)
        into[:count] = message[at : at + count]
        at += count
        return count

    with pytest.raises(rpc_codec.BrokenMessage):
        rpc_codec.receive(read)


@pytest.mark.skipif(sys.platform != "linux", reason="memory of another process is read on Linux only")
def test_large_arrays_are_copied_from_the_senders_memory(rng):
    large, small, sent = rng.random((300, 200)), rng.random(5), bytearray()
    lent = rpc_codec.send(lambda part: sent.extend(part) or len(part), {"a": large, "b": [small, large]}, True)
    assert [a is large for a in lent] == [True] and len(sent) < 1000
    stream = io.BytesIO(bytes(sent))
    found, _ = rpc_codec.receive(
        stream.readinto, lambda address, into: shared_copy.copy_from(os.getpid(), address, into)
    )
    assert np.array_equal(found["a"], large) and np.array_equal(found["b"][0], small) and found["b"][1] is found["a"]
    assert found["a"].ctypes.data != large.ctypes.data
    with pytest.raises(OSError):
        shared_copy.copy_from(os.getpid(), 64, memoryview(bytearray(8)))


@pytest.mark.parametrize("allowed", [True, False])
def test_lent_or_through_the_pipe_a_picture_is_the_same(tmp_path, monkeypatch, rng, allowed):
    pixels = rng.integers(0, 256, (400, 500, 3))
    write_png(tmp_path / "a.png", pixels / 255)
    reader_process.stop()
    if not allowed:
        monkeypatch.setattr(shared_copy, "can_read", lambda process, address: False)
    for _ in range(2):
        assert np.array_equal(np.rint(read_picture(tmp_path / "a.png").rgb * 255), pixels)
    assert reader_process._reader.lends == (allowed and sys.platform == "linux")
    reader_process.stop()


@pytest.mark.skipif(sys.platform != "linux", reason="/proc and glibc")
def test_what_the_child_keeps_for_the_next_file_it_gives_back_when_none_comes(tmp_path):
    np.save(tmp_path / "a.npy", np.ones(6_000_000))
    reader_process.stop()

    def held() -> int:
        return int(Path(f"/proc/{child()}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    for _ in range(2):
        assert read_npy(tmp_path / "a.npy").sum() == 6_000_000
    most, deadline = held(), time.monotonic() + 20
    while held() > most - 40_000_000 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert held() < most - 40_000_000


@pytest.mark.parametrize("threads", [1, 3])
def test_parts_of_a_file_are_read_whole_on_any_number_of_threads(tmp_path, monkeypatch, rng, threads):
    content = rng.bytes(20_000_003)
    (tmp_path / "a").write_bytes(content)
    monkeypatch.setattr(bounds, "READ_THREADS", threads)
    assert bounds.read_part(tmp_path / "a", 5, 19_000_000) == content[5:19_000_005]
    assert bounds.read_part(tmp_path / "a", 3, 1 << 40) == content[3:]
    assert bounds.read_part(tmp_path / "a", 30_000_000, 7) == b""
    with pytest.raises(InputRefused, match="found nothing"):
        bounds.read_part(tmp_path / "b", 0, 1)


def test_memory_that_cannot_be_copied_is_a_refusal_and_the_next_file_gets_a_new_child(tmp_path, monkeypatch, rng):
    write_png(tmp_path / "a.png", rng.random((400, 500, 3)))
    read_size(tmp_path / "a.png")
    if not reader_process._reader.lends:
        pytest.skip("this system does not let a process read its child's memory")
    with monkeypatch.context() as patch:
        patch.setattr(shared_copy, "copy_from", lambda process, address, into: (_ for _ in ()).throw(OSError(14, "no")))
        with pytest.raises(InputRefused, match="its decoder ended"):
            read_picture(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").rgb.shape == (400, 500, 3)


# --- absurd files ---


def accessors(count: int) -> str:
    tree = {
        "asset": {"version": "2.0"},
        "accessors": [{"type": "VEC3", "componentType": 5126, "count": count}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
    }
    return json.dumps(tree)


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
LAUGHS += "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9))
NPY = (
    b"\x93NUMPY\x01\x00v\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117)
    + b"\n"
)
BOMBS = {
    "zeros.gltf": (accessors(99_999_999).encode(), read_mesh, "99999999 elements of POSITION"),
    "laughs.yaml": (LAUGHS.encode(), read_yaml, "more than 1000000 values"),
    "deep.toml": (b"a = " + b"[" * 50_000 + b"]" * 50_000, read_toml, "no TOML|deeper"),
    "date.toml": (b"a = 2020-01-01", read_toml, "found a date"),
    "object.yaml": (b"a: !!python/object/apply:os.system ['true']", read_yaml, "no YAML"),
    "huge.json": (b'{"a": 1' + b"0" * 400 + b"}", read_json, "more than 64 bits"),
    "infinite.json": (b'{"a": [1e999]}', read_json, "beyond what a double holds"),
    "shape.npy": (NPY, read_npy, "no array.*greater than file size"),
    "buffers.gltf": (
        json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": 2**30, "uri": "a.bin"}] * 9}).encode(),
        read_mesh,
        "buffers of 9216 MiB",
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_small_files_that_ask_for_much_are_refused_early(name: str, tmp_path: Path):
    content, reader, words = BOMBS[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputRefused, match=words) as refusal:
        reader(tmp_path / name)
    assert name in str(refusal.value)
    assert reader_process.peak_bytes() < 2e9


def test_nasty_meshes_are_all_in_the_table():
    from tests.io.meshes.test_read import NASTY

    assert {p.name for p in data("meshes/nasty").iterdir()} == set(NASTY)


# --- weights ---


def tensors(table: object, data: bytes = bytes(48)) -> bytes:
    head = json.dumps(table).encode()
    return struct.pack("<Q", len(head)) + head + data


def entry(kind: object = "F32", shape: object = (3, 4), at: object = (0, 48)) -> dict:
    return {"dtype": kind, "shape": shape, "data_offsets": at}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff" * 8,
        struct.pack("<Q", 10**9) + b"{}",
        tensors([]),
        tensors({"a": entry("F31")}),
        tensors({"a": entry(at=(0, 52))}),
        tensors({"a": entry(shape=(3, 5))}),
        tensors({"a": entry(shape=(-3, -4))}),
        tensors({"a": entry(at=(-48, 0))}),
        tensors({"a": entry(), "b": entry(shape=(3,), at=(40, 52))}, bytes(60)),
        tensors({"a": entry(shape=(2**40, 2**40))}),
        tensors({"a": 3}),
        tensors({"a": entry(shape=None)}),
        tensors({"__metadata__": {"a": 1}}),
        b"\x80\x04pickle",
    ],
)
def test_damaged_safetensors_are_refused(content: bytes, tmp_path: Path):
    (tmp_path / "a.safetensors").write_bytes(content)
    with pytest.raises(InputRefused, match="a.safetensors"):
        weights.tensors(tmp_path / "a.safetensors")


def test_safetensors_are_mapped_and_may_be_changed_in_memory(tmp_path: Path):
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    path = tmp_path / "a.safetensors"
    path.write_bytes(tensors({"a": entry(), "b": entry("F16", (0,), (48, 48))}, values.tobytes()))
    found = weights.tensors(path)
    assert np.array_equal(found["a"].numpy(), values) and found["b"].shape == (0,)
    found["a"][0, 0] = 7
    assert np.array_equal(weights.tensors(path)["a"].numpy(), values)


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(20_000_000, np.float32))
    with pytest.raises(InputRefused, match="unpacks to 80000.* at most 200 times"):
        weights.tensors(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", a=np.arange(5), b=np.ones((2, 3), np.float16))
    found = weights.tensors(tmp_path / "b.npz")
    assert found["a"].tolist() == [0, 1, 2, 3, 4] and found["b"].shape == (2, 3)
