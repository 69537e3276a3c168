"""Lights as records and as JSON: every kind comes back, single views have their own, environments turn."""

import json

import numpy as np
import pytest

from mistyle.core.errors import InputRefused
from mistyle.core.light import (
    Ambient,
    Directional,
    Environment,
    Point,
    SceneLights,
    SphericalGaussian,
    bake_environment,
    environment_directions,
    environment_radiance,
    from_json,
    lights_of_views,
    spherical_gaussian,
    to_json,
    turn_about_y,
)

SUN = Directional((0.0, 0.6, 0.8), (1.0, 2.0, 3.0))
FLASH = Point((0.0, 0.0, 0.0), (4.0, 4.0, 4.0), "camera")
LAMP = Point((1.0, -2.0, 0.5), (4.0, 5.0, 6.0))


def through_text(rig, views=None):
    return json.loads(json.dumps(to_json(rig, views)))


def test_every_kind_comes_back():
    rig = (SUN, FLASH, LAMP, Ambient((1.0, 1.0, 1.0)), SphericalGaussian((0.0, 1.0, 0.0), 4.0, (1.0, 0.5, 0.2)))
    rig = (*rig, SceneLights("studio.xml"))
    assert from_json(through_text(rig)) == rig


def test_an_environment_is_loaded_by_its_name(rng):
    radiance = rng.random((4, 8, 3)).astype(np.float32)
    light = Environment(radiance, 30.0, 2.0, "studio.hdr")
    asked = []

    def load(file):
        asked.append(file)
        return radiance

    (read,) = from_json(through_text((light,)), load=load)
    assert asked == ["studio.hdr"] and isinstance(read, Environment)
    assert read.radiance is radiance and (read.turn, read.scale, read.file) == (30.0, 2.0, "studio.hdr")
    (plain,) = from_json({"lights": [{"type": "environment", "file": "a.exr"}]}, load=load)
    assert isinstance(plain, Environment) and (plain.turn, plain.scale) == (0.0, 1.0)
    with pytest.raises(InputRefused, match="studio.hdr.*without files"):
        from_json(through_text((light,)))
    with pytest.raises(ValueError, match="without a file"):
        to_json((Environment(radiance),))


def test_views_with_lights_of_their_own():
    data = through_text((SUN,), {"b": (FLASH,), "dark": ()})
    assert lights_of_views(data, ["a", "b", "dark"]) == ((SUN,), (FLASH,), ())
    assert from_json(data) == (SUN,)
    del data["lights"]
    assert lights_of_views(data, ["b"]) == ((FLASH,),)
    with pytest.raises(InputRefused, match="no lights for the view 'a' .1 of 2 views.*Add it to \"views\""):
        lights_of_views(data, ["a", "b"])


def test_a_misspelt_view_is_not_given_the_common_lights():
    with pytest.raises(InputRefused, match="'B', which is not one of the 1 views"):
        lights_of_views(through_text((SUN,), {"B": (FLASH,)}), ["b"])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ({}, "list at lights; found NoneType"),
        ({"views": []}, '"views" is a list'),
        ({"views": {"a": {}}}, r"views\['a'\]; found dict"),
        ({"views": {"a": [{"type": "laser"}]}}, r"views\['a'\]\[0\]: type is 'laser'; .*point, environment"),
        ({"lights": [{"type": "point", "position": [0, 0], "intensity": [1, 1, 1]}]}, "position"),
        ({"lights": [{"type": "point", "position": [0, 0, 1], "intensity": [1, -1, 1]}]}, ">= 0"),
        ({"lights": [{"type": "point", "position": [0, 0, 1], "intensity": [1, 1, 1], "frame": 3}]}, "frame is 3"),
        ({"lights": [{"type": "environment"}]}, "file is None"),
        ({"lights": [{"type": "environment", "file": "a.hdr", "turn": "left"}]}, "turn is 'left'"),
        ({"lights": [{"type": "environment", "file": "a.hdr", "scale": -1}]}, "scale is -1"),
    ],
)
def test_what_is_wrong_is_named(data, reason):
    with pytest.raises(InputRefused, match=reason):
        lights_of_views(data, ["a"], load=lambda file: np.zeros((2, 4, 3), np.float32))


def test_an_environment_gives_its_own_texels_where_they_lie(rng):
    radiance = rng.random((9, 16, 3)).astype(np.float32)
    seen = environment_radiance(Environment(radiance, scale=3.0), environment_directions(9, 16))
    # At the poles a direction has no column.
    assert seen[1:-1] == pytest.approx(3 * radiance[1:-1], rel=1e-5)


def test_turning_takes_z_towards_x():
    assert turn_about_y(90.0) @ [0, 0, 1] == pytest.approx([1, 0, 0])
    radiance = np.zeros((33, 64, 3), np.float32)
    towards = environment_directions(33, 64)
    radiance[towards[..., 2] > 0.9] = 1.0
    turned = Environment(radiance, turn=90.0)
    assert environment_radiance(turned, np.array([1.0, 0, 0])) == pytest.approx(1)
    assert environment_radiance(turned, np.array([0, 0, 1.0])) == pytest.approx(0)


def test_a_baked_environment_adds_up():
    """A smooth lobe, sampled, turned and baked again, is the lobe about the turned axis."""
    axis = np.array([0.36, 0.48, 0.8])
    lobe = SphericalGaussian((0.36, 0.48, 0.8), 6.0, (1.0, 2.0, 3.0))
    sampled = Environment(bake_environment((lobe,), 128), turn=50.0)
    x, y, z = (turn_about_y(50.0) @ axis).tolist()
    expected = spherical_gaussian(SphericalGaussian((x, y, z), 6.0, (1.0, 2.0, 3.0)), environment_directions(64, 128))
    baked = bake_environment((sampled, Ambient((0.5, 0.5, 0.5))), 64)
    # Linear interpolation over 1.4 degrees of a lobe whose second derivative is 6 per radian squared.
    assert np.abs(baked - 0.5 - expected).max() < 3 * 6 * np.radians(1.41) ** 2 / 8 * 2
    with pytest.raises(ValueError, match="Point"):
        bake_environment((LAMP,))
