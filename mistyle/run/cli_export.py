"""The verb `mistyle export`."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mistyle.run.options import examples


def add_export(verbs: Any) -> None:
    verb = verbs.add_parser(
        "export",
        help="a finished asset for Blender, Unreal, Unity, Houdini or Arnold: maps packed, USD, MaterialX, OBJ",
        **examples(
            """
            mistyle export out/ -o delivered/ --target unreal                    what a run made, packed for Unreal
            mistyle export out/ -o delivered/ --target houdini --formats usd mtlx maps
            mistyle export out/asset/ -o web/ --formats glb
            mistyle export out/ -o v3/ --target arnold --name '{asset}_v003_{map}.{udim}.{ext}'
            """
        ),
    )
    verb.add_argument("asset", type=Path, metavar="ASSET", help="a run folder, its asset folder, or its <name>.json")
    verb.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    verb.add_argument("--formats", nargs="+", default=["maps", "glb"], metavar="F", help="glb usd mtlx obj maps")
    verb.add_argument(
        "--target", default="blender", help="blender (default), unreal, unity-urp, unity-hdrp, houdini or arnold"
    )
    verb.add_argument("--name", default=None, metavar="PATTERN", help="texture files: {asset} {map} {udim} {ext}")
    verb.add_argument(
        "--metres-per-unit", type=float, default=1.0, metavar="X", help="what USD says of the mesh's units"
    )
    verb.add_argument("--json", action="store_true", help="the files as one JSON object on stdout")
    verb.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    from mistyle.run.deliver import NAMES, export

    files = export(
        options.asset,
        options.out,
        formats=options.formats,
        target=options.target,
        names=options.name or NAMES,
        metres_per_unit=options.metres_per_unit,
    )
    if options.json:
        print(json.dumps({"files": [str(p) for p in files]}))
    else:
        print("\n".join(str(p) for p in files), file=sys.stderr)
    return 0
