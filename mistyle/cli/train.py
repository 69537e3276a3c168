"""`mistyle train`: ConsisLoRA's LoRAs from a style picture or from rendered views."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mistyle.cli.models import add_model_options
from mistyle.cli.options import add_job_options, examples, given_settings
from mistyle.core.errors import UsageError
from mistyle.process.cores import use_threads

if TYPE_CHECKING:
    from mistyle.stylization.diffusion.lora_files import TrainingImage

OPTIONS = {
    "seed": "seed",
    "threads": "threads",
    "word": "word",
    "models": "models.folder",
    "checkpoint": "models.checkpoint",
    "steps": "train.steps",
}


def add_train(verbs: Any) -> None:
    verb = verbs.add_parser(
        "train",
        help="train LoRAs of a style picture or of views, for the diffusion stylizer",
        **examples(
            """
            mistyle train style starry_night.jpg -o loras/ --models DIR
            mistyle train content views/ -o loras/ --models DIR          one LoRA per view that `mistyle render` wrote
            mistyle stylize bunny.obj starry_night.jpg -o out/ --stylizer diffusion --models DIR --loras loras/
            """
        ),
    )
    verb.add_argument("kind", nargs="?", choices=["style", "content"], help="style of a picture, or content of views")
    verb.add_argument("source", type=Path, nargs="?", metavar="PICTURE|VIEWS_DIR")
    verb.add_argument("-o", "--out", type=Path, metavar="DIR", help="folder of LoRAs; rerun to resume")
    verb.add_argument("--word", help="the prompt's token for the picture (default [v] for style, [c] for content)")
    verb.add_argument("--steps", type=int, metavar="N", help="steps of the first phase (default 1500)")
    add_model_options(verb)
    add_job_options(verb, ("draft", "standard"), "draft: a third of the steps; standard (default): ConsisLoRA's")
    verb.set_defaults(command=run_train)


def run_train(options: argparse.Namespace) -> int:
    """Train missing LoRAs and print the files."""
    from mistyle.jobs.settings import as_toml, resolve, thread_count
    from mistyle.stylization.diffusion.train_settings import TRAIN_PRESETS, TrainJobSettings

    chosen = given_settings(options, OPTIONS)
    settings = resolve(options.preset, options.config, chosen, root=TrainJobSettings, presets=TRAIN_PRESETS)
    if options.print_config:
        sys.stdout.write(as_toml(settings))
        return 0
    if options.kind is None or options.source is None or options.out is None:
        raise UsageError("train needs style PICTURE or content VIEWS_DIR, and -o DIR; see mistyle train --help")
    from mistyle.jobs.progress import Progress
    from mistyle.stylization.models.folder import need_extra

    need_extra()
    images = training_set(options.kind, options.source, settings.word)
    from mistyle.stylization.diffusion.lora_files import LoraFolder, make_all
    from mistyle.stylization.diffusion.lora_files import check as check_models

    use_threads(thread_count(settings))
    check_models(settings.models, settings.train)
    progress = Progress()
    with bar(progress.say) as watch:
        folder = LoraFolder(options.out, options.overwrite)
        pairs = make_all(settings.models, images, folder, settings.train, settings.seed, progress.say, watch)
    files = [str(halves.style if options.kind == "style" else halves.content) for halves in pairs]
    print(json.dumps({"loras": files}) if options.json else "\n".join(files))
    return 0


def training_set(kind: str, source: Path, word: str) -> "list[TrainingImage]":
    """The pictures to train LoRAs on."""
    from mistyle.core.image import srgb_from_linear
    from mistyle.stylization.diffusion.lora_files import TrainingImage

    if kind == "style":
        from mistyle.io.read import read_picture
        from mistyle.stylization.pipeline.generative import opaque

        return [TrainingImage("style", source.stem, opaque(read_picture(source)), word or "[v]")]
    from mistyle.io.cameras.views import read_views

    views = read_views(source)
    return [TrainingImage("content", v.camera.name, srgb_from_linear(v.rgb), word or "[c]") for v in views]


@contextmanager
def bar(say: Callable[[str], None]) -> Iterator[Callable[[int, int, float], None]]:
    """A progress bar with the mean loss over its weight on a terminal, occasional lines elsewhere."""
    from mistyle.stylization.pipeline.generative import watcher

    if not sys.stderr.isatty():
        yield watcher(say, lambda share: None)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = [TextColumn("{task.description:<32}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Bars(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task("training", total=None)
        mean = 0.0

        def watch(step: int, steps: int, loss: float) -> None:
            nonlocal mean
            # The losses of single steps vary with their noise levels.
            mean = loss if mean == 0 else 0.98 * mean + 0.02 * loss
            bars.update(task, completed=step, total=steps, description=f"loss over weight {mean:.4f}")

        yield watch
