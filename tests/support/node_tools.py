"""Independent judges from npm: Khronos' glTF validator and the MikkTSpace reference as WebAssembly.

They are installed once into a cache outside the repository ($MISTYLE_CACHE, else ~/.cache/mistyle); a test that needs
them is skipped, saying so, where node, npm or the registry is out of reach.
"""

import json
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest

NO_NODE = "no node with npm packages"
PACKAGES = ("gltf-validator@2.0.0-dev.3.10", "mikktspace@1.1.1")

VALIDATE = """
const fs = require('fs'), path = require('path'), validator = require('gltf-validator');
const run = async (file) => {
  const folder = path.dirname(file);
  const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
    uri: path.basename(file), maxIssues: 0,
    externalResourceFunction: (uri) => fs.promises.readFile(path.join(folder, decodeURIComponent(uri))),
  });
  return report.issues;
};
Promise.all(process.argv.slice(1).map(run)).then((all) => console.log(JSON.stringify(all)));
"""

TANGENTS = """
const fs = require('fs'), { generateTangents } = require('mikktspace'), folder = process.argv[1];
const read = (name) => { const b = fs.readFileSync(`${folder}/${name}`);
  return new Float32Array(b.buffer.slice(b.byteOffset, b.byteOffset + b.length)); };
const tangents = generateTangents(read('positions'), read('normals'), read('uvs'));
fs.writeFileSync(`${folder}/tangents`, Buffer.from(tangents.buffer, tangents.byteOffset, tangents.byteLength));
"""


@cache
def modules() -> Path | str:
    """The folder node_modules, or why there is none."""
    if not shutil.which("node") or not shutil.which("npm"):
        return f"{NO_NODE}: node and npm are not installed"
    home = Path(os.environ.get("MISTYLE_CACHE") or Path.home() / ".cache" / "mistyle") / "npm"
    place = home / "-".join(p.replace("@", "_") for p in PACKAGES)
    if not place.is_dir():
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=home) as folder:
            (Path(folder) / "package.json").write_text("{}")
            command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES]
            try:
                done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
            except subprocess.TimeoutExpired:
                return f"{NO_NODE}: npm install took longer than 120 s"
            if done.returncode:
                return f"{NO_NODE}: npm install failed: {done.stderr.strip()[-300:]}"
            try:
                os.rename(Path(folder) / "node_modules", place)
            except OSError:
                assert place.is_dir(), "another process has installed the packages meanwhile"
    return place


def node(script: str, *arguments: str) -> str:
    place = modules()
    if isinstance(place, str):
        pytest.skip(place)
    command = ["node", "-e", script, *arguments]
    env = os.environ | {"NODE_PATH": str(place)}
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True, timeout=60).stdout


def gltf_issues(*files: Path) -> list[dict]:
    """What the glTF validator says of each file: numErrors, numWarnings, messages."""
    return json.loads(node(VALIDATE, *map(str, files)))


def mikktspace(positions: np.ndarray, normals: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """The reference's tangents (f 3 4) of corners (f 3 3), (f 3 3), (f 3 2)."""
    with tempfile.TemporaryDirectory() as folder:
        for name, values in {"positions": positions, "normals": normals, "uvs": uvs}.items():
            (Path(folder) / name).write_bytes(np.ascontiguousarray(values, np.float32).tobytes())
        node(TANGENTS, folder)
        return np.frombuffer((Path(folder) / "tangents").read_bytes(), np.float32).reshape(-1, 3, 4)
