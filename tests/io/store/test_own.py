"""JSON of our own, however it was damaged, is an OSError or a ValueError."""

import pytest

from mistyle.io.store.trusted_json import read_own


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b'{"a": ' * 50_000, b" " * 65 + b"1"])
def test_damage_is_a_value_error(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError):
        read_own(tmp_path / "a.json", limit=64 if content.startswith(b" ") else 1 << 20)


def test_what_was_written_is_read(tmp_path):
    (tmp_path / "a.json").write_text('{"a": [1, 2.5, null, "ü"]}', encoding="utf-8")
    assert read_own(tmp_path / "a.json") == {"a": [1, 2.5, None, "ü"]}
    with pytest.raises(OSError):
        read_own(tmp_path / "b.json")
