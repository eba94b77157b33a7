"""How the user wants masks to be read. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class MaskReading:
    """How masks are read."""

    is_inverted: bool = False
    """True to read white as black, and black as white."""
    may_be_large: bool = False
    """True to take masks that look as if they were the other way round as they are."""
    is_used: bool = True
    """False if neither masks nor alpha channels hide anything of photographs."""
    is_turned_by_option: bool = True
    """False if `--invert-masks` is for the masks of another option."""
    folder: Path | None = None
    """Folder of masks in place of those that lie beside photographs; white there is ignored."""
    left_out: Path | None = None
    """Folder of masks that mean something else, such as what to remove. It may lie where masks are
    looked for, unless `folder` says where that is."""

    @property
    def ignores_white(self) -> bool:
        """True if masks of photographs are white, not black, where a photograph is ignored."""
        return self.is_inverted != (self.folder is not None)
