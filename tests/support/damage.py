"""Words that tell a person nothing about a damaged file."""

import re

OBSCURE = re.compile(
    r"object at 0x|buffer|reshape|unpack_from|subscript|invalid literal|out of bounds|out of range"
    r"|broadcast|dtype|NoneType|not iterable|has no attribute|list indices|not supported between"
    r"|argument must|unexpected keyword|could not convert|KeyError|Errno|Error \d|got none"
    r"|no field of name|not in list|axis|float\(\)|int\(\)|not a valid|end-of-stream"
)
"""Words of Python, NumPy, Pillow and zlib about their own objects."""


def require_plain(sentence: str) -> str:
    """Check that a sentence has no word of a library, and return it."""
    found = OBSCURE.search(sentence)
    assert found is None, sentence
    assert "\n" not in sentence
    return sentence
