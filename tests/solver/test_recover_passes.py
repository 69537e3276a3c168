"""A recovery as numbered passes: interrupted anywhere, limited by number or time, stopped, and continued."""

import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from mistyle.atlas.texels import rasterise
from mistyle.core.capture import in_memory
from mistyle.core.errors import Stopped
from mistyle.core.light import Ambient
from mistyle.process import stopping
from mistyle.render.mitsuba import device
from mistyle.solver.recover import Checkpoints, Limits, recover
from mistyle.solver.schedule import schedule, seconds, shares, size_from
from tests.render.deferred.test_seam import sphere
from tests.solver.test_recover import LIGHTS, QUICK, SIZE, directional, errors, fibonacci, photographs, strong_maps

# Every kind of pass: solve, rounds with and without an estimate of indirect light, pictures, joint, polish.
BRIEF = QUICK.model_copy(
    update={"iterations": 24, "rounds": 1, "bounces": 2, "bounce_samples": 8, "joint": 2, "joint_subsamples": 4}
)
PASSES = 9


@pytest.fixture(scope="module")
def small():
    """Four views of a sphere under one light each."""
    device.use()
    mesh, maps = sphere(), strong_maps()
    cameras = [replace(c, name=f"{c.name}.{k}") for k, c in enumerate(fibonacci(4, 64))]
    lights = [(directional(*LIGHTS[k % 3]),) for k in range(4)]
    pictures = photographs(mesh, [maps], cameras, lights, "mikkt", {"type": "direct"}, 16)
    return mesh, maps, rasterise(mesh, 0, SIZE), in_memory(cameras, lights, pictures)


def fit(small, settings=BRIEF, **more):
    mesh, _, texels, captures = small
    return recover(mesh, [texels], captures, settings, 5, **more)


def same(one, other) -> bool:
    names = ("albedo", "normal", "roughness", "metallic", "known")
    return all(getattr(one.maps[0], n).tobytes() == getattr(other.maps[0], n).tobytes() for n in names)


@pytest.fixture(scope="module")
def whole(small):
    """An undisturbed run, and the checkpoints of all places where one may be written."""
    states = []
    often = BRIEF.model_copy(update={"checkpoint": 1e-9})
    return fit(small, often, checkpoints=Checkpoints(save=states.append)), states


def test_a_run_from_any_checkpoint_ends_with_the_same_bytes(small, whole):
    result, states = whole
    assert result.passes == result.planned == PASSES and len(states) > 60
    assert all(isinstance(v, np.ndarray) and v.dtype != object for s in states for v in s.values())
    parts = {name.split("/")[1] for state in states for name in state if name.startswith("part/")}
    kinds = ("light.0", "solve.start0", "round0.try1", "round3", "adam", "joint1")
    assert all(kind in parts for kind in kinds), parts
    last = {part: k for k, state in enumerate(states) for part in {n.split("/")[1] for n in state if n[0] == "p"}}
    for k in sorted({last[kind] for kind in kinds} | {0, len(states) // 2, len(states) - 1}):
        reports = []
        resumed = fit(small, checkpoints=Checkpoints(resume=states[k]), progress=reports.append)
        assert same(resumed, result) and resumed.trace == result.trace and resumed.notes == result.notes, k
        assert reports == sorted(reports)


def test_a_number_of_passes_gives_the_maps_of_that_pass(small, whole):
    _, maps, texels, _ = small
    seen, saved = [], []
    limits = Limits(passes=4, watch=lambda reached: seen.append((reached.done, reached.planned, reached.maps()[0])))
    some = fit(small, limits=limits, checkpoints=Checkpoints(save=saved.append))
    assert [s[:2] for s in seen] == [(k, PASSES) for k in range(1, 5)]
    assert (some.passes, some.planned) == (4, PASSES) and not same(some, whole[0])
    assert same(fit(small, limits=Limits(passes=4)), some)
    chosen = texels.covered & (some.seen[0] >= 2)
    wrong = [np.abs(errors(m, maps, chosen)[2]).mean() for m in (seen[0][2], some.maps[0], whole[0].maps[0])]
    assert wrong[2] < wrong[0] and wrong[1] < 1.2 * wrong[0]
    more = fit(small, checkpoints=Checkpoints(resume=saved[-1]))
    assert more.passes == PASSES and same(more, whole[0]), "it continues where the limit ended it"
    assert same(fit(small, limits=Limits(passes=4), checkpoints=Checkpoints(resume=saved[-1])), some)
    assert same(
        fit(small, limits=Limits(passes=2), checkpoints=Checkpoints(resume=saved[-1])),
        fit(small, limits=Limits(passes=2)),
    )


def test_a_time_limit_leaves_whole_passes(small):
    """One pass at least; the interrupted pass leaves no trace in the result."""
    none = fit(small, limits=Limits(deadline=time.monotonic()))
    assert none.passes == 1 and same(none, fit(small, limits=Limits(passes=1)))

    with pytest.MonkeyPatch.context() as patch:
        real, over = time.monotonic, []
        patch.setattr("mistyle.solver.journal.time.monotonic", lambda: 1e12 if over else real())
        watch = lambda reached: over.append(1) if reached.done == 6 else None  # noqa: E731
        limited = fit(small, limits=Limits(deadline=1e11, watch=watch))
    assert limited.passes == 6
    exact = fit(small, limits=Limits(passes=6))
    assert same(limited, exact) and limited.trace == exact.trace


def test_a_stop_request_saves_the_pass_and_ends_soon(small, whole):
    saved, reached, asked = [], [], []

    def progress(done):
        if len(reached) == 4 and not asked:
            asked.append(time.monotonic())
            signal.raise_signal(signal.SIGTERM)

    with stopping.listening():
        with pytest.raises(Stopped):
            limits = Limits(watch=reached.append)
            fit(small, checkpoints=Checkpoints(save=saved.append), progress=progress, limits=limits)
        assert time.monotonic() - asked[0] < 5
    assert len(saved) == 1
    assert same(fit(small, checkpoints=Checkpoints(resume=saved[0])), whole[0])


def test_soft_light_resumes_too(small):
    mesh, _, texels, captures = small
    lit = replace(captures, lights=((Ambient((1.0, 1.0, 1.0)),),) * len(captures))
    settings = BRIEF.model_copy(update={"iterations": 16, "bounces": 0, "checkpoint": 1e-9})
    states = []
    result = fit((mesh, None, texels, lit), settings, checkpoints=Checkpoints(save=states.append))
    assert same(fit((mesh, None, texels, lit), settings, checkpoints=Checkpoints(resume=states[-2])), result)


def test_the_plan_s_shares_follow_its_seconds():
    settings = BRIEF
    passes, size = schedule(settings, 4, True), size_from(settings, [64 * 64] * 4, 2000, soft=False)
    assert len(passes) == PASSES and [p.kind for p in passes][:2] == ["solve", "rounds"]
    marks = shares(settings, passes, size)
    assert marks == sorted(marks) and marks[-1] == pytest.approx(1)
    each = [seconds(settings, one, size) for one in passes]
    np.testing.assert_allclose(np.diff(marks) / np.diff(marks).sum(), np.array(each) / sum(each))
