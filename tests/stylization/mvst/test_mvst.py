"""The sweep over a stylizer that paints one view at a time."""

import numpy as np
import pytest

from mistyle.core.camera import angular_order, rig
from mistyle.core.image import erode, match_histogram, overlap, srgb_from_linear
from mistyle.core.settings import RigSettings
from mistyle.core.view import Prior, View
from mistyle.stylization.mvst.settings import SweepSettings
from mistyle.stylization.mvst.sweep import PaintedView, ViewPainter, ViewStore, sweep, towards, visiting
from tests.stylization.mvst.test_warp import BALL, at, colours, see

SETTINGS = SweepSettings()


def ring(size: int = 64) -> list[View]:
    return [see(at(30 + 60 * k, size=size), [BALL]) for k in range(6)]


class Noise:
    """Paints what is not known with noise of its own; remembers what it was shown. Fails in the view `broken`."""

    def __init__(self, broken: int | None = None) -> None:
        self.seen: list[tuple[str, Prior | None]] = []
        self.broken = broken

    def __call__(self, view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        if len(self.seen) == self.broken:
            raise RuntimeError("killed")
        self.seen.append((view.camera.name, prior))
        rgb = rng.random(view.rgb.shape, dtype=np.float32)
        return rgb if prior is None else np.where(prior.known[..., None], prior.rgb, rgb)


def disagreement(views: list[View]) -> float:
    """Mean difference between a view and its neighbour carried into it."""
    from mistyle.stylization.mvst.settings import WarpSettings
    from mistyle.stylization.mvst.warp import composite, lift

    plain = WarpSettings(erosion=0, fill=0)
    errors = []
    for a, b in zip(views, [*views[1:], views[0]], strict=True):
        prior = composite([lift(a, plain)], b, plain)
        errors.append(np.abs(prior.rgb - b.rgb)[prior.known & erode(b.mask, 2)].mean())
    return float(np.mean(errors))


def test_views_agree_after_a_sweep_and_not_without():
    views = ring()
    apart = [v for v in sweep(views, ViewPainter(lambda v, p, rng: Noise()(v, None, rng)), SETTINGS, 0).views]
    together = list(sweep(views, ViewPainter(Noise(), keeps_outlines=True), SETTINGS, 0).views)
    # Noise of one pixel is the worst case: landing half a pixel off already shows another value.
    assert disagreement(together) < 0.4 * disagreement(apart)


def test_the_first_view_has_no_prior_and_the_others_what_was_painted():
    stylizer = Noise()
    swept = sweep(ring(), ViewPainter(stylizer, keeps_outlines=True), SETTINGS, 0)
    assert stylizer.seen[0][1] is None
    assert swept.painted[swept.order[0]].known == 0
    for k, (_, prior) in zip(swept.order[1:], stylizer.seen[1:], strict=True):
        assert isinstance(prior, Prior) and prior.known.sum() > 100
        assert swept.painted[k].known == pytest.approx(prior.known[swept.views[k].mask].mean())
        assert np.array_equal(swept.views[k].rgb[prior.known], prior.rgb[prior.known])
    # The ring closes: the last view lies between two finished ones.
    assert swept.painted[swept.order[-1]].known > 0.7


def test_orders_of_the_papers_rig():
    cameras = rig(RigSettings(resolution=16))
    paper = visiting(cameras, "paper")
    assert paper == list(range(16)) == visiting(cameras, "given")
    names = [(cameras[k].azimuth, cameras[k].elevation) for k in visiting(cameras, "angular")]
    ring_first = [30, 60, 360, 90, 330, 120, 300, 150, 270, 180, 240, 210]
    assert names[:12] == [(a, 0) for a in ring_first]
    assert names[12:] == [(30, 45), (30, 89), (30, -45), (30, -89)]
    assert visiting(cameras[::-1], "paper")[0] == 15 == visiting(cameras[::-1], "angular")[0]


def test_cameras_without_angles_keep_their_order_in_the_papers():
    from dataclasses import replace

    cameras = [replace(c, azimuth=float("nan")) for c in rig(RigSettings(resolution=16))][::-1]
    assert visiting(cameras, "paper") == list(range(16))
    assert sorted(visiting(cameras, "angular")) == list(range(16))
    assert angular_order([]) == []


def test_a_killed_sweep_goes_on_in_the_view_it_was_in(tmp_path):
    views = ring(48)
    whole = sweep(views, ViewPainter(Noise()), SETTINGS, 7)
    with pytest.raises(RuntimeError):
        sweep(views, ViewPainter(Noise(broken=3)), SETTINGS, 7, store=ViewStore(tmp_path, "job"))
    rest = Noise()
    resumed = sweep(views, ViewPainter(rest), SETTINGS, 7, store=ViewStore(tmp_path, "job"))
    assert len(rest.seen) == 3
    for a, b in zip(whole.views, resumed.views, strict=True):
        assert np.array_equal(a.rgb, b.rgb)
    # Another key, a damaged file: painted again.
    (tmp_path / "view_000.npz").write_bytes(b"half a fi")
    again = Noise()
    sweep(views, ViewPainter(again), SETTINGS, 7, store=ViewStore(tmp_path, "job"))
    assert [name for name, _ in again.seen] == [views[0].camera.name]
    other = Noise()
    sweep(views, ViewPainter(other), SETTINGS, 7, store=ViewStore(tmp_path, "another job"))
    assert len(other.seen) == 6


def test_the_seed_decides():
    views = ring(32)
    a, b, c = (sweep(views, ViewPainter(Noise()), SETTINGS, seed).views for seed in (1, 1, 2))
    assert all(np.array_equal(x.rgb, y.rgb) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a[0].rgb, c[0].rgb)


def test_later_views_are_drawn_to_the_anchors_colours():
    """A stylizer that paints every view in another brightness; nothing is known, the views look from two sides."""
    views = [see(at(30), [BALL]), see(at(210), [BALL])]

    def drifting(view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        return (0.8 if prior is None else 0.3) * colours(rng.normal(size=(view.mask.size, 3))).reshape(view.rgb.shape)

    means = {}
    for strength in (0.0, 0.5, 1.0):
        settings = SWEEP.model_copy(update={"histogram": strength})
        swept = sweep(views, ViewPainter(drifting), settings, 0)
        inner = [srgb_from_linear(v.rgb)[p.mask].mean() for v, p in zip(swept.views, swept.painted, strict=True)]
        means[strength] = inner
    assert means[0.0][0] == means[1.0][0]
    gap = [means[s][0] - means[s][1] for s in (0.0, 0.5, 1.0)]
    assert gap[0] > 0.15 and gap[1] == pytest.approx(gap[0] / 2, rel=0.1) and abs(gap[2]) < 0.01


SWEEP = SweepSettings()


def test_the_match_leaves_what_came_from_the_prior(rng):
    rgb = rng.random((40, 40, 3), dtype=np.float32)
    mask, known = np.ones((40, 40), bool), np.zeros((40, 40), bool)
    known[:, :10] = True
    anchor = PaintedView(np.full((40, 40, 3), 0.5, np.float32), mask, mask, 0.0, 1.0)
    moved = towards(rgb, mask, known, anchor, 1.0)
    assert np.abs(moved - rgb)[known].max() < 1e-6
    assert np.abs(moved[:, 20:] - 0.5).max() < 1e-3
    off = towards(rgb, ~known, known, anchor, 1.0)
    assert np.abs(off - rgb)[known].max() < 1e-6


def test_masks_and_drift():
    """A segmenter that sees the thing three pixels to the right."""
    views = ring(64)[:2]

    def shifted(view: View) -> np.ndarray:
        assert view.rgb.any()
        return np.roll(view.mask, 3, axis=1)

    plain = sweep(views, ViewPainter(Noise()), SETTINGS, 0)
    assert all(p.drift == 1 for p in plain.painted)
    for view, painted in zip(views, plain.painted, strict=True):
        assert np.array_equal(painted.mask, erode(view.mask & (view.coverage > 0.995), 1))
    seen = sweep(views, ViewPainter(Noise(), masker=shifted, keeps_outlines=True), SETTINGS, 0)
    for view, painted in zip(views, seen.painted, strict=True):
        assert painted.drift == pytest.approx(overlap(view.mask, shifted(view)))
        assert 0.8 < painted.drift < 0.97
        assert not (painted.mask & ~shifted(view)).any()
    settings = SweepSettings(mask_erosion=4)
    assert np.array_equal(sweep(views, ViewPainter(Noise()), settings, 0).painted[0].mask, erode(views[0].mask, 4))


@pytest.mark.parametrize("follows", [False, True])
def test_depth_follows_the_outline_where_the_stylizer_moves_it(follows, monkeypatch):
    """A stylizer that draws the ball four pixels to the right: what is carried on has the depth of the drawn ball."""
    from mistyle.stylization.mvst import sweep as mvst

    views = [see(at(a, size=128), [(0.0, 0.0, 0.0, 0.7)]) for a in (0, 25)]
    lifted = []

    def shifting(view: View, prior: Prior | None, rng: np.random.Generator) -> np.ndarray:
        return np.roll(view.mask, 4, axis=1)[..., None] * np.ones(3, np.float32)

    def watched(view: View, settings, mask):
        lifted.append((view, mask))
        return lift(view, settings, mask)

    lift = mvst.lift
    monkeypatch.setattr(mvst, "lift", watched)
    settings = SweepSettings(follow_outline=follows, mask_erosion=0)
    sweep(views, ViewPainter(shifting, masker=lambda view: view.rgb[..., 0] > 0.5), settings, 0)
    for view, (shown, mask) in zip(views, lifted, strict=True):
        drawn = np.roll(view.mask, 4, axis=1)
        assert np.array_equal(shown.mask, drawn if follows else view.mask)
        assert np.array_equal(mask, drawn if follows else drawn & view.mask)
        assert np.isfinite(shown.depth[mask]).all() and shown.rgb[mask].min() == 1
        truth = np.roll(view.depth, 4, axis=1)
        rim = mask & ~erode(drawn, 4) & view.mask
        stale, now = (float(np.abs(depth[rim] - truth[rim]).mean()) for depth in (view.depth, shown.depth))
        assert stale > 0.03
        assert now < 0.4 * stale if follows else now == stale


def test_what_a_stylizer_may_not_give():
    views = ring(32)[:1]
    with pytest.raises(ValueError, match="shape"):
        sweep(views, ViewPainter(lambda v, p, r: np.zeros((3, 3, 3), np.float32)), SETTINGS, 0)
    with pytest.raises(ValueError, match="finite"):
        sweep(views, ViewPainter(lambda v, p, r: np.full(v.rgb.shape, np.nan, np.float32)), SETTINGS, 0)
    with pytest.raises(ValueError, match="no views"):
        sweep([], ViewPainter(Noise()), SETTINGS, 0)


def test_histogram_match_gives_the_targets_distribution(rng):
    values, target = rng.normal(size=(5000, 3)), rng.beta(2, 5, (3000, 3))
    matched = match_histogram(values.astype(np.float32), target.astype(np.float32))
    for channel in range(3):
        a, b = (np.quantile(x[:, channel], np.linspace(0, 1, 50)) for x in (matched, target))
        assert np.abs(a - b).max() < 0.01
        assert (np.diff(matched[np.argsort(values[:, channel]), channel]) >= -1e-6).all()
    assert np.array_equal(match_histogram(values, target, 0.0), values)
    half = match_histogram(values.astype(np.float32), target.astype(np.float32), 0.5)
    assert np.abs(half - (matched + values) / 2).max() < 1e-5
    flat = match_histogram(np.full((10, 1), 0.3, np.float32), target[:, :1].astype(np.float32))
    assert flat == pytest.approx(np.full((10, 1), target[:, 0].mean()), abs=0.01)
    assert match_histogram(values[:0], target).shape == (0, 3)


def test_overlap():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert overlap(a, b) == 1
    a[:, :2] = True
    b[:, 1:3] = True
    assert overlap(a, b) == pytest.approx(4 / 12)
    assert overlap(a, ~a) == 0
