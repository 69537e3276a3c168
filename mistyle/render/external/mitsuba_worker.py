"""Runs in a separate environment with Mitsuba only: renders a scene file.

Takes one JSON file: scene (XML), sensor, integrator (a dictionary; null: the scene's own), variants in order of
preference, and shots (out .npy, passes, spp of a pass, seed). Writes beside the job file a `.done` JSON with Mitsuba's
version and the seconds of each shot. Does not import mistyle.
"""

import json
import sys
import time

import mitsuba as mi
import numpy as np


def main(path):
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    available = mi.variants()
    mi.set_variant(*[name for name in job["variants"] if name in available])
    scene = mi.load_file(job["scene"])
    chosen = {} if job["integrator"] is None else {"integrator": mi.load_dict(job["integrator"])}
    seconds = []
    for shot in job["shots"]:
        start, total = time.perf_counter(), 0
        for k in range(shot["passes"]):
            seed = (shot["seed"] + k * 0x9E3779B1) % 2**32
            picture = mi.render(scene, sensor=job["sensor"], spp=shot["spp"], seed=seed, **chosen)
            total = total + np.array(picture, dtype=np.float64)
        seconds.append(time.perf_counter() - start)
        np.save(shot["out"], (total / shot["passes"]).astype(np.float32)[..., :4])
    with open(path + ".done", "w", encoding="utf-8") as file:
        json.dump({"mitsuba": mi.__version__, "variant": mi.variant(), "seconds": seconds}, file)


if __name__ == "__main__":
    main(sys.argv[-1])
