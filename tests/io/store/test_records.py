"""Records come back from disk as they went in, and a forged record cannot name foreign code."""

import json

import numpy as np
import pytest

from mistyle.core.camera import look_at
from mistyle.core.errors import InputRefused
from mistyle.core.maps import flat_maps
from mistyle.io.store.records import load_record, save_record


def test_round_trip_keeps_values_types_and_bytes(tmp_path):
    record = {
        "maps": (flat_maps(4), flat_maps(8, albedo=0.25)),
        "camera": look_at((1, 2, 3), fov=30, size=(4, 6)),
        "note": None,
    }
    save_record(tmp_path / "r", record)
    back = load_record(tmp_path / "r")
    assert type(back["maps"]) is tuple and back["note"] is None
    assert back["camera"].size == (4, 6)
    assert back["camera"].world_from_cam.tobytes() == record["camera"].world_from_cam.tobytes()
    for a, b in zip(record["maps"], back["maps"], strict=True):
        assert a.albedo.dtype == b.albedo.dtype and np.array_equal(a.albedo, b.albedo)
        assert b.known.dtype == bool


@pytest.mark.parametrize("name", ["os:system", "mistyle.core.errors:MistyleError", "mistyle.core.nothing:X"])
def test_foreign_classes_are_refused(tmp_path, name):
    (tmp_path / "record.json").write_text(json.dumps({"record": name, "fields": {}}))
    with pytest.raises((InputRefused, ImportError)):
        load_record(tmp_path)


def test_array_names_cannot_leave_the_folder(tmp_path):
    (tmp_path / "record.json").write_text(json.dumps({"array": "../../etc/x"}))
    with pytest.raises(InputRefused, match="bad array name"):
        load_record(tmp_path)
