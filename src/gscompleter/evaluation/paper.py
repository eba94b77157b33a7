"""The paper's data sets, tables, figures and claims, as `paper.yaml` lists them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Literal

import yaml
from pydantic import TypeAdapter

from gscompleter.config.generators import GeneratorOptions
from gscompleter.config.settings import Settings
from gscompleter.evaluation.authors_loader import AuthorsLoader

TRUTH = "truth"
"""Name of the photograph of the target, among the images of a figure."""
PHOTOGRAPH = "context-"
"""Beginning of the names of the given photographs."""


@dataclass(frozen=True)
class DataSet(Settings):
    """Options of `evaluate` for a data set of the paper; the defaults are those of no data set."""

    protocol: tuple[str, ...] = ()
    resolution: tuple[int, int] | None = None
    reconstructor: tuple[str, ...] = ("plane-sweep",)
    generator: str = GeneratorOptions.generator
    near: float | None = None
    far: float | None = None
    """Depth range in scene units; None for that of the data, or else of the model's authors."""
    loader: AuthorsLoader | None = None
    """Rules of the authors' data loader; None if nobody's code is followed."""


@dataclass(frozen=True)
class Requirements(Settings):
    """Runs that a table or a figure needs."""

    title: str
    protocol: tuple[str, ...] = ()
    """Protocols of the cases; empty for that of the command, or else of the data set."""
    generator: str | None = None
    """Generator that it is about; None for that of the command, or else of the data set."""
    one_per_scene: bool = False
    """True to run only the first case of each scene, because a method is slow."""

    def list_methods(self) -> tuple[str, ...]:
        """List the methods to run."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class TableSpec(Requirements):
    """A table with a row for each model, protocol and method."""

    methods: tuple[str, ...]
    baseline: str
    """Method to which differences are given."""
    columns: tuple[str, ...]
    """Scores in its columns, keys of `columns.BY_KEY`."""

    def list_methods(self) -> tuple[str, ...]:
        """List the methods to run."""
        return self.methods


@dataclass(frozen=True, kw_only=True)
class FigureSpec(Requirements):
    """A grid of images with a row for each case."""

    images: tuple[str, ...]
    """Methods, `context-N` for the N-th given photograph, `truth` for that of the target."""

    def list_methods(self) -> tuple[str, ...]:
        """List the methods to run."""
        return tuple(name for name in self.images if not is_photograph(name))


@dataclass(frozen=True)
class Claim(Settings):
    """A claim that a method is better than another in a column of a table."""

    says: str
    """The claim, as a sentence."""
    paper: str
    """The paper's numbers, of the method after those of the baseline."""
    table: str
    """Key of a table of `Paper.tables`, which has the column and both methods."""
    column: str
    method: str
    baseline: str
    better: Literal["higher", "lower"]
    """Direction in which the paper says that the method differs from the baseline."""
    model: str | None = None
    """Ψ that the claim is about; None for all."""
    over_spans: bool = False
    """True if the difference is said to grow from the first protocol of the table to the last."""


@dataclass(frozen=True)
class Paper(Settings):
    """Content of `paper.yaml`."""

    data_sets: Mapping[str, DataSet]
    tables: Mapping[str, TableSpec]
    figures: Mapping[str, FigureSpec]
    claims: Sequence[Claim]


@cache
def load_paper() -> Paper:
    """Load and validate `paper.yaml`."""
    content: Any = yaml.safe_load(files(__package__).joinpath("paper.yaml").read_bytes())
    return TypeAdapter(Paper).validate_python(content)


def get_data_set(preset: str | None) -> DataSet:
    """Return the data set of a preset, or the defaults without one."""
    return DataSet() if preset is None else load_paper().data_sets[preset]


def is_photograph(image: str) -> bool:
    """Return True if an image of a figure is a photograph instead of a render."""
    return image == TRUTH or image.startswith(PHOTOGRAPH)


def select_names(
    given: Iterable[str], known: Mapping[str, Requirements], generator: str
) -> dict[str, Requirements]:
    """Select tables or figures by name, each once and in the order in which they are named.

    `all` stands for those that run with `generator`, that of the command; one that is named is
    taken with the generator that it needs.
    """
    # The oracle needs no model: it returns the photograph of the target.
    usable = (generator, "oracle", None)
    every = {name: spec for name, spec in known.items() if spec.generator in usable}
    chosen: dict[str, Requirements] = {}
    for name in given:
        chosen |= every if name == "all" else {name: known[name]}
    return chosen
