"""The references of a recovery without their indirect light, and progress of parts."""

import numpy as np

from mistyle.core.camera import look_at
from mistyle.core.capture import in_memory
from mistyle.core.light import Directional
from mistyle.core.stage_progress import StageProgress
from mistyle.solver.context import DISTRUST, DirectCaptures


def test_an_estimate_makes_another_record_and_leaves_the_old_one():
    camera, light = look_at([0, 0, 4], fov=30, size=(4, 4)), Directional((0.0, 0.0, 1.0), (1.0, 1.0, 1.0))
    captures = in_memory([camera], [(light,)], [np.full((4, 4, 3), 1.0, np.float32)])
    whole = DirectCaptures(captures)
    direct = whole.with_indirect(0, np.full((2, 2, 3), 0.25, np.float32))
    assert (whole.load(0)[0] == 1).all() and (whole.pixel_confidence(0) == 1).all()
    np.testing.assert_allclose(direct.load(0)[0], 0.75)
    np.testing.assert_allclose(direct.direct_only().load(0)[0], 0.75)
    np.testing.assert_allclose(direct.pixel_confidence(0), 0.75 / (0.75 + DISTRUST * 0.25))


def test_parts_of_parts_report_shares_of_the_whole():
    heard: list[float] = []
    part = StageProgress(heard.append).part(0.5, 1.0).part(0.2, 0.4)
    part(0.0)
    part(1.0)
    np.testing.assert_allclose(heard, [0.6, 0.7])
