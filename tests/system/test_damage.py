"""Words for damaged files, whatever error a decoder raises."""

import io
import json
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from damage import require_plain
from gscompleter import InputError
from gscompleter.system.damage import DamagedError, check_rows, describe_damage
from gscompleter.system.files.depth_file import read_depth
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.reading import parse_json


def catch(call) -> Exception:
    with pytest.raises(Exception) as caught:  # noqa: PT011
        call()
    return caught.value


DECODERS = {
    "numpy": lambda: np.frombuffer(b"hello", "<f4"),
    "shape": lambda: np.zeros(5).reshape(2, 3),
    "place": lambda: np.zeros(5)[7],
    "json": lambda: {"a": 1}["a"]["b"],  # type: ignore[index]
    "number": lambda: int("SCALAR"),
    "zip": lambda: zipfile.ZipFile(io.BytesIO(b"PK\x03\x04")),
    "image": lambda: Image.open(io.BytesIO(b"hello")),
    "text": lambda: b"\xff".decode(),
    "no key": lambda: {}["x"],
    "odd key": lambda: {}["There is no item named 'x' in the archive"],
}


@pytest.mark.parametrize("kind", DECODERS)
def test_errors_of_decoders_become_a_clause(kind):
    clause = require_plain(describe_damage(catch(DECODERS[kind])))
    assert clause.startswith("it")


def test_a_reader_has_the_last_word():
    assert describe_damage(DamagedError("it ends here")) == "it ends here"
    assert describe_damage(KeyError("focal")) == "it lacks the entry 'focal'"


def test_what_an_error_tells_is_said():
    """A lack of memory is no damage, and an archive names what it lacks."""
    assert describe_damage(MemoryError()) == "it needs more memory than there is"
    archive = zipfile.ZipFile(io.BytesIO(b"PK\5\6" + bytes(18)))
    missing = catch(lambda: archive.getinfo("depth/0.png"))
    assert describe_damage(missing) == "it lacks the entry 'depth/0.png'"
    # A number is a place in a table of the decoder.
    assert describe_damage(KeyError(17)) == "its content is damaged"
    cut = catch(lambda: zlib.decompress(zlib.compress(bytes(99))[:-5]))
    assert "too early" in describe_damage(cut)
    wrong = catch(lambda: zlib.decompress(b"hello"))
    assert describe_damage(wrong) == "its content is damaged"


def test_rows_that_are_missing_are_counted():
    check_rows(60, 6, 10)
    with pytest.raises(DamagedError, match="^it ends after 9 of 10 Gaussians$"):
        check_rows(59, 6, 10)
    with pytest.raises(DamagedError, match="^it ends after 0 of 10 points$"):
        check_rows(-5, 6, 10, "points")


def test_json_that_was_cut_is_told_from_json_that_is_wrong():
    whole = json.dumps({"frames": [1, 2, {"name": "a.png"}]})
    for length in range(1, len(whole)):
        with pytest.raises(InputError, match="not JSON"):
            parse_json(whole[:length].encode(), "a.json", "copy it again")
    for length in (5, len(whole) - 1, len(whole) - 5):
        with pytest.raises(InputError, match="ends too early.*; copy it again"):
            parse_json(whole[:length].encode(), "a.json", "copy it again")
    for nothing in (b"", b" \n"):
        with pytest.raises(InputError, match=r"\(it is empty\)"):
            parse_json(nothing, "a.json", "copy it again")
    with pytest.raises(InputError, match=r"\(line 2, column 3\)"):
        parse_json(b"{\n  wrong: 1}", "a.json", "copy it again")


def test_images_and_depth_maps_that_were_cut(tmp_path):
    file = io.BytesIO()
    Image.fromarray(np.arange(3000, dtype=np.uint8).reshape(25, 40, 3)).save(file, "JPEG")
    for length in (1, 30, 400):
        with (
            pytest.raises(InputError, match="is not an image that can be read") as error,
            open_image(file.getvalue()[:length], "the photograph") as image,
        ):
            np.array(image)
        require_plain(str(error.value))
    np.save(tmp_path / "a.npy", np.ones((9, 9), np.float32))
    data = (tmp_path / "a.npy").read_bytes()
    for length in (3, 100, len(data) - 5):
        (tmp_path / "a.npy").write_bytes(data[:length])
        with pytest.raises(InputError, match="depth map") as error:
            read_depth(tmp_path / "a.npy", 1.0)
        require_plain(str(error.value))
