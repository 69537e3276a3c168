"""Turntables as files: PNG frames with transparency, an animated WebP that browsers play, and mp4 as an extra."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mistyle.core.errors import EnvironmentMissing
from mistyle.io.images.write import write_png
from mistyle.io.store.atomic import atomic_write

SECONDS = 6.0  # once round
GROUND = (0.115, 0.115, 0.12)  # sRGB, behind the asset where a file has no transparency


Frame = Float[np.ndarray, "h w 4"] | UInt8[np.ndarray, "h w 4"]


def write_turn(place: Path, frames: Sequence[Frame], mp4: bool = False) -> list[Path]:
    """Write straight sRGB frames with alpha (0..1, or 8 bits) as `place`/000.png …, `place`.webp and, with `mp4`,
    `place`.mp4.

    `place` is a new folder: frames of an earlier turn would remain.

    The same frames give the same PNG and WebP bytes. EnvironmentMissing for `mp4` without an encoder.
    """
    if mp4:
        encoder()
    place.mkdir(parents=True, exist_ok=True)
    straight = [frame.astype(np.float32) / np.float32(255) if frame.dtype == np.uint8 else frame for frame in frames]
    for k, frame in enumerate(straight):
        write_png(place / f"{k:03}.png", frame)
    flat = [grounded(frame) for frame in straight]
    written = [place, place.with_suffix(".webp")]
    write_webp(written[1], flat)
    if mp4:
        written.append(place.with_suffix(".mp4"))
        write_mp4(written[2], flat)
    return written


def grounded(frame: Float[np.ndarray, "h w 4"]) -> np.ndarray:
    """A frame composited over GROUND, uint8."""
    alpha = np.clip(frame[..., 3:], 0, 1)
    return np.round((np.clip(frame[..., :3], 0, 1) * alpha + (1 - alpha) * np.array(GROUND)) * 255).astype(np.uint8)


def write_webp(path: Path, frames: Sequence[np.ndarray]) -> None:
    """Frames (h w 3) uint8 as an endless animated WebP."""
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    step = round(1000 * SECONDS / len(frames))
    options = {"save_all": True, "append_images": rest, "duration": step, "loop": 0, "quality": 85, "method": 4}
    atomic_write(path, lambda temporary: first.save(temporary, "WEBP", **options))


def write_mp4(path: Path, frames: Sequence[np.ndarray]) -> None:
    """Frames (h w 3) uint8 as H.264, 4:2:0; an odd row or column is left out."""
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])

    def write(temporary: Path) -> None:
        settings = {"fps": max(1, round(len(frames) / SECONDS)), "codec": "libx264", "macro_block_size": 1}
        stream = encoder().write_frames(
            str(temporary), (width, height), **settings, output_params=["-crf", "16", "-movflags", "+faststart"]
        )
        stream.send(None)
        for frame in frames:
            stream.send(np.ascontiguousarray(frame[:height, :width]))
        stream.close()

    atomic_write(path, write)


def encoder():
    """The imageio_ffmpeg module, which includes an ffmpeg binary. EnvironmentMissing where it is not installed."""
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise EnvironmentMissing(
            "mp4 needs an encoder that is not part of mistyle (H.264 encoders are GPL): "
            "pip install 'mistyle[video]', or leave --mp4 out; the .webp plays in every browser"
        ) from None
    return imageio_ffmpeg
