"""Measures of a job's style pictures and the settings derived from them, for the console, run.json and the report."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mistyle.core.asset import Picture
from mistyle.jobs.progress import Progress
from mistyle.stylization.settings import Settings
from mistyle.stylization.surface.exemplar.chosen import FROM_PAINTING, settled
from mistyle.stylization.surface.exemplar.reading import StyleReading, read_style
from mistyle.stylization.surface.settings import ResolvedSettings


@dataclass(frozen=True)
class StyleLook:
    """One style picture: its file name, its measures, its settings, and the names of those `chosen` from it."""

    name: str
    reading: StyleReading
    settings: ResolvedSettings
    chosen: tuple[str, ...]

    def record(self) -> dict[str, Any]:
        """For run.json: the measures, the settings that can derive from them, and which of these did."""
        settings = {name: getattr(self.settings, name) for name in FROM_PAINTING}
        return {
            "picture": self.name,
            "reading": asdict(self.reading),
            "settings": settings,
            "from_the_picture": list(self.chosen),
        }


def style_looks(style: Picture, name: str, settings: Settings, progress: Progress) -> tuple[StyleLook, ...]:
    """Measure the style and the slots' pictures, and report one line for each; empty for diffusion."""
    from mistyle.deliver.colour import read_style as read_file
    from mistyle.stylization.surface.layers import masked_style

    if settings.stylizer == "diffusion":
        return ()
    pictures = {name: masked_style(style, settings.paint.style_mask)}
    for slot in settings.paint.slots:
        path = Path(slot.rpartition("=")[2])
        if path.is_file():  # a slot without its picture is refused where slots are placed
            pictures[slot.rpartition("=")[0] + "=" + path.name] = read_file(path, settings.colour)
    looks = tuple(look(picture, called, settings) for called, picture in pictures.items())
    for entry in looks:
        progress.say(f"{entry.name}: {sentence(entry)}")
    return looks


def look(picture: Picture, name: str, settings: Settings) -> StyleLook:
    """Measures and settings of one picture."""
    reading = read_style(picture.rgb, picture.alpha)
    chosen = tuple(key for key in FROM_PAINTING if getattr(settings.surface, key) is None)
    return StyleLook(name, reading, settled(picture.rgb, picture.alpha, settings.surface, reading), chosen)


def sentence(one: StyleLook) -> str:
    """Measures and settings in one line."""
    return f"{measures(one.reading)}; settings: {choices(one)}"


def measures(reading: StyleReading) -> str:
    """The measures of a picture as text."""
    grid = "x".join(str(side) for side in reading.pixel_grid)
    return (
        f"unit {reading.unit:.2f} of the long side (clarity {reading.clarity:.2f}), lines {reading.line_likeness:.2f}, "
        f"flat {reading.flatness:.2f}, rectilinear {reading.rectilinear:.2f}, tiled {reading.tiled:.2f}, "
        f"tones {reading.tones}" + ("" if reading.pixel_grid == (0, 0) else f", art pixels of {grid}")
    )


def choices(one: StyleLook) -> str:
    """The settings derived from a picture, and those the user set."""
    shown = {name: getattr(one.settings, name) for name in FROM_PAINTING}
    shown["crop"] = "/".join(f"{share:.3f}" for share in one.settings.crop)
    shown["omit"] = "; ".join("/".join(f"{edge:.2f}" for edge in box) for box in one.settings.omit) or "nothing"
    chosen = [f"{name} {value}" for name, value in shown.items() if name in one.chosen]
    fixed = [f"{name} {value} (set)" for name, value in shown.items() if name not in one.chosen]
    return ", ".join(chosen + fixed)


def look_facts(looks: tuple[StyleLook, ...]) -> tuple[tuple[str, str], ...]:
    """For the report: one line of measures and one of settings for each picture."""
    return tuple(
        fact
        for one in looks
        for fact in ((f"{one.name}, measures", measures(one.reading)), (f"{one.name}, settings", choices(one)))
    )
