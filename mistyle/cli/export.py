"""The verbs `mistyle export` and `mistyle verify`."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mistyle.cli.options import NAME_HELP, add_overwrite_option, examples


def add_export(verbs: Any) -> None:
    verb = verbs.add_parser(
        "export",
        help="write a finished asset for Blender, Unreal, Unity, Houdini or Arnold",
        **examples(
            """
            mistyle export out/ -o delivered/ --target unreal                    a run's asset, packed for Unreal
            mistyle export out/ -o delivered/ --target houdini --formats usd,mtlx,maps
            mistyle export out/asset/ -o web/ --formats glb
            mistyle export out/ -o show/ --name '{mesh}_{style}_v{v:03}'         v001, v002, ... side by side
            mistyle export out/ -o film/ --target arnold --colorspace ACEScg     EXR in the names of $OCIO
            """
        ),
    )
    verb.add_argument("asset", type=Path, metavar="ASSET", help="a run folder, its asset folder, or its <name>.json")
    verb.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="several targets: DIR/<target>")
    verb.add_argument("--formats", nargs="+", default=["maps", "glb"], metavar="F", help="glb usd mtlx obj maps")
    verb.add_argument(
        "--target",
        nargs="+",
        default=["blender"],
        metavar="T",
        help="blender (default), unreal, unity-urp, unity-hdrp, houdini, arnold",
    )
    verb.add_argument("--name", default="{asset}", metavar="PATTERN", help=NAME_HELP.format(default=""))
    verb.add_argument("--texture-name", metavar="PATTERN", help="texture files: {asset} {map} {udim} {ext}")
    verb.add_argument("--source", type=Path, metavar="FILE", help="present path of the USD file under a look")
    verb.add_argument(
        "--metres-per-unit", type=float, default=1.0, metavar="X", help="metresPerUnit of USD (default 1)"
    )
    verb.add_argument("--colorspace", metavar="NAME", help="linear space of EXR textures (default: linear Rec.709)")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="the files as one JSON object on stdout")
    verb.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    import os

    from mistyle.deliver.export import DeliveryRequest, export
    from mistyle.jobs.deliver_settings import TEXTURES, ColourSettings, listed
    from mistyle.jobs.progress import Progress

    colour = ColourSettings(space=options.colorspace, config=os.environ.get("OCIO") or None)
    targets, files, progress = listed(options.target), [], Progress()
    for target in targets:
        files += export(
            options.asset,
            options.out / target if len(targets) > 1 else options.out,
            DeliveryRequest(
                formats=listed(options.formats),
                target=target,
                name=options.name,
                names=options.texture_name or TEXTURES,
                metres_per_unit=options.metres_per_unit,
                colour=colour,
                source=options.source,
            ),
            overwrite=options.overwrite,
            note=progress.note,
            say=progress.say,
        )
    if options.json:
        print(json.dumps({"files": [str(p) for p in files], "notes": progress.notes}))
    else:
        print("\n".join(str(p) for p in files), file=sys.stderr)
    progress.tell_notes()
    return 0


def add_verify(verbs: Any) -> None:
    verb = verbs.add_parser(
        "verify",
        help="open written files with independent readers, render them in Cycles and Mitsuba",
        **examples(
            """
            mistyle verify out/                                  a run folder: its manifest, its GLB, its deliveries
            mistyle verify delivered/ --blender /opt/bpy/bin/python
            mistyle verify chair.glb -o checked/ --no-render
            """
        ),
    )
    verb.add_argument("asset", type=Path, metavar="ASSET", help="a run, batch, asset or delivered folder, or one file")
    verb.add_argument("-o", "--out", type=Path, metavar="DIR", help="pictures and verify.json (default ASSET/verify)")
    verb.add_argument(
        "--blender", metavar="PATH", help="blender, or a python with bpy (default: on PATH, or MISTYLE_BLENDER_PYTHON)"
    )
    verb.add_argument("--no-render", action="store_true", help="only open the files")
    verb.add_argument("--views", type=int, default=3, metavar="N", help="cameras around the asset (default 3)")
    verb.add_argument("--size", type=int, default=256, metavar="N", help="pixels along each side (default 256)")
    verb.add_argument("--spp", type=int, default=128, metavar="N", help="samples per pixel (default 128)")
    verb.add_argument("--light", default="studio", metavar="L", help="studio (default), key, grazing, or an .exr, .hdr")
    verb.add_argument("--threads", type=int, default=0, metavar="N", help="threads of the renderers (default: all)")
    add_overwrite_option(verb)
    verb.add_argument("--json", action="store_true", help="the outcome as one JSON object on stdout")
    verb.set_defaults(command=_verify)


def _verify(options: argparse.Namespace) -> int:
    from mistyle.deliver.verify import Rendering, table, verify

    rendering = None
    if not options.no_render:
        rendering = Rendering(options.views, options.size, options.spp, options.light, options.threads)
    record = verify(
        options.asset, options.out, blender=options.blender, rendering=rendering, overwrite=options.overwrite
    )
    if options.json:
        print(json.dumps(record))
    print(table(record), file=sys.stderr)
    return 5 if record["failed"] else 0
