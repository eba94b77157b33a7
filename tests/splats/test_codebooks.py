"""Codebooks and palettes: the nearest entry is taken, and few values are kept."""

import numpy as np
import pytest

from gscompleter.splats.codebooks import CODEBOOK_SIZE, MIN_PALETTE_SIZE, fit_codebook, fit_palette


def skewed(count: int) -> np.ndarray:
    """Make values of which most lie close together, and two far away."""
    values = np.random.default_rng(0).standard_normal((count, 3)).astype(np.float32) ** 3
    values[7, 1], values[8, 2] = -90, 70
    return values


def test_a_codebook_is_sorted_and_each_value_has_its_nearest_entry():
    values = skewed(2000)
    book, codes = fit_codebook(values)
    assert book.shape == (CODEBOOK_SIZE,)
    assert (np.diff(book) >= 0).all()
    distances = np.abs(values[..., None] - book)
    chosen = np.take_along_axis(distances, codes[..., None].astype(int), axis=2)[..., 0]
    assert (chosen <= distances.min(2) + 1e-6 * np.abs(values).max()).all()


def test_a_codebook_is_closer_than_even_steps_and_keeps_what_is_rare():
    values = skewed(20_000)
    book, codes = fit_codebook(values)
    error = np.abs(book[codes] - values)
    step = (values.max() - values.min()) / (CODEBOOK_SIZE - 1)
    even = np.abs(np.rint((values - values.min()) / step) * step + values.min() - values)
    assert np.square(error).mean() < 0.2 * np.square(even).mean()
    assert error.max() <= 2 * step


@pytest.mark.parametrize("values", [[3.0], [1.0, 1.0, 1.0], [-2.0, 5.0, 0.25]])
def test_a_codebook_of_few_values_holds_them(values):
    given = np.array(values, np.float32)[:, None]
    book, codes = fit_codebook(given)
    assert book.shape == (CODEBOOK_SIZE,)
    assert np.allclose(book[codes], given, rtol=1e-6)


def test_few_rows_are_a_palette_as_they_are():
    rows = np.random.default_rng(1).standard_normal((50, 9)).astype(np.float32)
    repeated = rows[np.arange(9000) % 50]
    palette, labels = fit_palette(repeated)
    assert len(palette) == 50
    assert np.array_equal(palette[labels], repeated)


def test_many_rows_share_a_palette_that_is_closer_than_a_choice_of_rows():
    random = np.random.default_rng(2)
    rows = random.standard_normal((3 * MIN_PALETTE_SIZE, 6)).astype(np.float32)
    rows[: MIN_PALETTE_SIZE // 2] = 0
    palette, labels = fit_palette(rows)
    assert len(palette) <= MIN_PALETTE_SIZE
    assert labels.min() >= 0
    assert labels.max() < len(palette)
    error = np.square(palette[labels] - rows).sum(1)
    some = rows[random.permutation(len(rows))[:MIN_PALETTE_SIZE]]
    sample = random.permutation(np.arange(MIN_PALETTE_SIZE // 2, len(rows)))[:300]
    nearest = np.square(rows[sample, None] - some).sum(2).min(1)
    assert error[sample].mean() < 0.8 * nearest.mean()
    assert np.array_equal(palette, fit_palette(rows)[0])


def test_a_row_far_from_all_others_is_kept():
    """It is a cell of its own, of one row."""
    rows = np.random.default_rng(3).standard_normal((2 * MIN_PALETTE_SIZE, 5)).astype(np.float32)
    rows[77] = 1000 + np.arange(5)
    palette, labels = fit_palette(rows)
    assert np.allclose(palette[labels[77]], rows[77])
    assert np.abs(palette[labels] - rows).max() < 10
