"""`mistyle models`: lists, downloads, converts and adopts models of the generative stages."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mistyle.cli.options import add_overwrite_option, examples
from mistyle.core.errors import UsageError

# Option -> dotted setting, for `add_generative_options`.
GENERATIVE_OPTIONS = {
    "inpainter": "inpainter",
    "models": "models.folder",
    "checkpoint": "models.checkpoint",
    "style_lora": "models.style_lora",
    "loras": "models.loras",
    "content": "diffusion.content",
    "style_adapter": "diffusion.adapter",
    "prompt": "paint3d.prompt",
}


def add_model_options(verb: Any) -> None:
    """Options for the paths of models, on a verb or a group of its options."""
    verb.add_argument(
        "--models", type=Path, metavar="DIR", help="folder of models, as `mistyle models` lays it out (else HF's cache)"
    )
    verb.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help="SDXL or a finetune as one .safetensors file, for its weights"
    )


def add_generative_options(verb: argparse.ArgumentParser) -> None:
    """Options of the generative stylizer and inpainter."""
    group = verb.add_argument_group("generative stages (need models: see mistyle models)")
    group.add_argument(
        "--inpainter", choices=["fill", "paint3d"], help="inpainter of the repair; fill (default) needs no models"
    )
    add_model_options(group)
    group.add_argument("--style-lora", type=Path, metavar="FILE", help="a style LoRA trained elsewhere (.safetensors)")
    group.add_argument("--loras", type=Path, metavar="DIR", help="folder of trained LoRAs")
    group.add_argument(
        "--content",
        choices=["auto", "none", "shared", "per-view"],
        help="content LoRAs: none, one from the first view, one per view as in the paper (hours)",
    )
    group.add_argument(
        "--style-adapter", choices=["lora", "ip"], help="lora: trained on the style; ip: an IP-Adapter, no training"
    )
    group.add_argument("--prompt", help="text prompt of the texture inpainter")


def add_models(verbs: Any) -> None:
    verb = verbs.add_parser(
        "models",
        help="list models of the generative stages with licences, or fetch them",
        **examples(
            """
            mistyle models --models DIR                             present and missing models, and the layout
            mistyle models fetch sdxl depth canny --models DIR --allow-download
            mistyle models convert position paint3d.bin --models DIR     a pickle into safetensors
            mistyle models adopt sdxl --models DIR                  accept DIR/sdxl though its hashes differ
            """
        ),
    )
    verb.add_argument("action", nargs="?", choices=["list", "fetch", "convert", "adopt"], default="list")
    verb.add_argument(
        "names", nargs="*", metavar="NAME", help="models to fetch or adopt; or NAME and the file to convert"
    )
    verb.add_argument("--models", type=Path, metavar="DIR", help="folder of models (else the Hugging Face cache)")
    verb.add_argument("--allow-download", action="store_true", help="fetch may use the network")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="one JSON object on stdout")
    verb.set_defaults(command=run_models)


def run_models(options: argparse.Namespace) -> int:
    """List, fetch, convert or adopt."""
    if options.action == "list":
        return _list(options)
    if options.models is None:
        raise UsageError(f"mistyle models {options.action} needs --models DIR, the folder to put them in")
    if options.action == "convert":
        return _convert(options)
    if not options.names:
        raise UsageError(f"mistyle models {options.action} NAME...; `mistyle models` prints the names")
    from mistyle.stylization.models.fetch import adopt, fetch
    from mistyle.stylization.models.folder import get

    for name in options.names:
        get(name)
    places = {}
    for name in options.names:
        if options.action == "adopt":
            places[name] = str(adopt(name, options.models))
        else:
            places[name] = str(fetch(name, options.models, options.allow_download, overwrite=options.overwrite))
        print(f"{name}: {places[name]}", file=sys.stderr)
    if options.json:
        print(json.dumps(places))
    return 0


def _convert(options: argparse.Namespace) -> int:
    from mistyle.stylization.models.fetch import adopt, convert
    from mistyle.stylization.models.folder import get, lacking, need_extra

    if len(options.names) != 2:
        raise UsageError("mistyle models convert NAME FILE.bin --models DIR")
    model, source = get(options.names[0]), Path(options.names[1])
    need_extra()
    pickle = source / "diffusion_pytorch_model.bin" if source.is_dir() else source
    place = options.models / model.name
    print(convert(pickle, place, overwrite=options.overwrite))
    if not lacking(model, place, model.loose):
        adopt(model.name, options.models)
    return 0


def _list(options: argparse.Namespace) -> int:
    from mistyle.stylization.models.fetch import listing

    rows = listing(options.models)
    if options.json:
        print(json.dumps({"models": rows}, indent=1))
        return 0
    for row in rows:
        print(f"{row['name']:<16} {row['found'] or 'not found'}")
        print(f"  {row['purpose']}")
        print(f"  {row['repo']} at {row['revision']}, {row['gigabytes']} GB, {row['licence']}")
        print(f"  in {options.models or 'DIR'}/{row['name']}: {', '.join(row['folders'])}")
        if row["url"]:
            print(f"  from {row['url']}")
        for file, value in row["sha256"].items():
            print(f"  sha256 {value}{'…' * (len(value) < 64)}  {file}")
    print(
        "\nNothing is downloaded without --allow-download: mistyle models fetch NAME --models DIR --allow-download. "
        "You accept each model's licence.\nRevisions and hashes come from other projects' lock files; downloaded and "
        "copied files are checked against them."
    )
    return 0
