"""Fetch the free assets of the benchmarks: `python -m benchmarks.data --out FOLDER`, then MISTYLE_DATA=FOLDER.

Every file has a pinned address and a SHA-256; what does not match is not kept, and what is there and matches is not
fetched again. All are CC0-1.0: Avocado and WaterBottle (Khronos glTF Sample Assets), the studio light (Poly Haven).
Standard library only; proxies are those of the environment.
"""

import argparse
import hashlib
import http.client
import os
import sys
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

KHRONOS = "https://raw.githubusercontent.com/KhronosGroup/glTF-Sample-Assets/5bad5aaa0bbb5d0f9cdc934e626f27d0df1e79b8"
DREI = "https://raw.githubusercontent.com/pmndrs/drei-assets/456060a26bbe"
TIMEOUT = 60
LARGEST = 32 * 2**20


@dataclass(frozen=True)
class Item:
    """One file: its path below the folder, its address, and its SHA-256."""

    path: str
    address: str
    sha256: str


def _khronos(model: str, files: dict[str, str]) -> tuple[Item, ...]:
    return tuple(
        Item(f"meshes/pbr/{model}/{name}", f"{KHRONOS}/Models/{model}/glTF/{name}", digest)
        for name, digest in files.items()
    )


ITEMS = (
    *_khronos(
        "Avocado",
        {
            "Avocado.gltf": "126401a585ad347769b4ce61e1a07618186455b14883507ad71dea2f111bc511",
            "Avocado.bin": "3bf7ce0ec994562eabf0cb72a52bbc7976818d630d62609a966b53a5ff9b9180",
            "Avocado_baseColor.png": "385dce948c3b9e8bc93e1c930d796e72b02cbd474b121a160d577de95ebbb48f",
            "Avocado_normal.png": "95aad56cefbaf448e04c6e6391d3cfbe405e730101cacb2d05e7c39312d42770",
            "Avocado_roughnessMetallic.png": "33ee80f7ccfd36825acfbd5ef0a51326bea49e33efed852dca44798798bd6901",
        },
    ),
    *_khronos(
        "WaterBottle",
        {
            "WaterBottle.gltf": "b369d49d86832b499b41c50b3d35e030ba7116eb367f1716a98df169a2c001db",
            "WaterBottle.bin": "e4921f2d0c0a03cf65286bd195f3688d4f99d7b6a58f25935e70d516d744156e",
            "WaterBottle_baseColor.png": "62d0ad9b4e2c75e9bc7d67644a50d697563000ffa586d2e185ea38f5000e0a63",
            "WaterBottle_emissive.png": "e9b03ea395b0182917f876befda2d31639ce46058c832dd64e5ad02cde5bddb9",
            "WaterBottle_normal.png": "f22c68da660cee50002ba9a3519e63f2024b21e3ae1bda6c0b5c3059b18212d8",
            "WaterBottle_occlusionRoughnessMetallic.png": (
                "10cc809d9762e8c671f1ae73618dd5fdd07792d2c6ec9c4691cdb991617c9369"
            ),
        },
    ),
    Item(
        "hdri/studio_small_03_1k.hdr",
        f"{DREI}/hdri/studio_small_03_1k.hdr",
        "29267a4aa8c10de26cae758e4e3c4daadde88673798666ad657724bab7224a35",
    ),
)


class NotFetched(Exception):
    """A file could not be had; the message says which, why, and what to do."""


def fetch(item: Item, folder: Path) -> bool:
    """Put one file into `folder`; False when it was there already. Raises NotFetched."""
    target = folder / item.path
    if target.is_file():
        if _digest(target.read_bytes()) == item.sha256:
            return False
        raise NotFetched(
            f"{target}: is there with other content (SHA-256 {_digest(target.read_bytes())[:12]}..., expected "
            f"{item.sha256[:12]}...). Move it away, or give another --out."
        )
    try:
        with urllib.request.urlopen(item.address, timeout=TIMEOUT) as answer:
            content = answer.read(LARGEST + 1)
    except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
        raise NotFetched(
            f"{item.address}: did not come ({getattr(error, 'reason', error)}). Check the network and HTTPS_PROXY, or "
            f"fetch it by other means to {target}."
        ) from error
    if _digest(content) != item.sha256:
        raise NotFetched(
            f"{item.address}: its content is not the pinned one ({len(content)} bytes with SHA-256 "
            f"{_digest(content)[:12]}..., expected {item.sha256[:12]}...). A proxy may have answered in its place."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    # Renamed when whole, so that a broken run leaves no half file behind.
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return True


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="where the files go")
    parser.add_argument("--list", action="store_true", help="print addresses and sums, fetch nothing")
    options = parser.parse_args(argv)
    if options.list:
        for item in ITEMS:
            print(f"{item.sha256}  {item.path}  {item.address}")
        return 0
    try:
        for item in ITEMS:
            print(f"{'fetched' if fetch(item, options.out) else 'was there'}  {item.path}")
    except NotFetched as error:
        print(error, file=sys.stderr)
        return 1
    print(f"Now: MISTYLE_DATA={options.out.resolve()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
