"""Functions that a user names as `file.py:function`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gscompleter.system.errors import InputError
from gscompleter.system.plugins import is_in_file, load_from_file


def write(folder: Path, text: str, name: str = "models.py") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_a_function_an_object_and_a_class_are_found(tmp_path):
    file = write(tmp_path, "def f(): return 3\nclass C:\n    x = 4\nvalue = C()\n")
    assert load_from_file(f"{file}:f", "depth")() == 3
    assert load_from_file(f"{file}:C", "depth").x == 4
    assert load_from_file(f"{file}:value", "depth").x == 4


def test_a_file_is_run_once_and_imports_its_neighbours(tmp_path):
    write(tmp_path, "count = []\n", "neighbour_of_models.py")
    file = write(tmp_path, "import neighbour_of_models as n\nn.count.append(1)\nf = n.count\n")
    assert load_from_file(f"{file}:f", "depth") == [1]
    assert load_from_file(f"{file}:f", "depth") == [1]


def test_a_file_that_two_options_name_is_run_once(tmp_path):
    file = write(tmp_path, "class Model: pass\n")
    depth = load_from_file(f"{file}:Model", "depth")
    assert type(load_from_file(f"{file}:Model", "generator")) is type(depth)


def test_two_files_of_one_name_are_two_modules(tmp_path):
    words = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        words.append(write(folder, f"value = {number}\n") + ":value")
    assert [load_from_file(word, "depth") for word in words] == [1, 2]


@pytest.mark.parametrize(
    ("text", "name", "sentence"),
    [
        ("def f(): pass\n", "g", "has no 'g'; it has f."),
        ("import torch\n", "g", "it has nothing that can be called."),
        ("import none_such_module\n", "f", "ModuleNotFoundError, line 1"),
        ("x = 1\ny = x / 0\n", "f", "ZeroDivisionError, line 2"),
        ("def f(:\n", "f", "SyntaxError, line 1"),
        ("import json\njson.loads('{\\n\\n!')\n", "f", "JSONDecodeError, line 2"),
        ("def f(): pass\nraise SystemExit(0)\n", "f", "SystemExit, line 2"),
        ("class C:\n    def __init__(self, n): pass\n", "C", "without arguments"),
        ("class C:\n    def __init__(self): self.f = 1 / 0\n", "C", "ZeroDivisionError, line 2"),
        ("class C:\n    def __init__(self): self.f = len(1)\n", "C", "made (TypeError, line 2"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, text, name, sentence):
    file = write(tmp_path, text)
    with pytest.raises(InputError, match=re.escape(sentence)) as error:
        load_from_file(f"{file}:{name}", "depth")
    assert error.value.argument == "depth"


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="There is no file"):
        load_from_file(f"{tmp_path}/none.py:f", "depth")


@pytest.mark.parametrize("word", ["plane-sweep", "a.py", "a.py:", "a.pyc:f", "a.py:f-g", None])
def test_other_words_are_names(word):
    assert not is_in_file(word)
