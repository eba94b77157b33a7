"""Lines end at the known pixels that they meet, and threads do not matter."""

import numba
import numpy as np

from gscompleter.numerics.kernels.streamlines import trace_lines


def traced(directions, limit=50.0):
    """Trace lines through a hole with a left border of 0 and a right border of 1."""
    image = np.zeros((32, 40, 3), np.float32)
    image[:, 20:] = 1
    known = np.ones((32, 40), bool)
    known[:, 10:20] = False
    field = np.broadcast_to(np.float32(directions), (32, 40, 2)).copy()
    return trace_lines(image, known, field, np.where(known, 0, limit).astype(np.float32))


def test_the_nearer_end_counts_more():
    colours, lengths = traced((1, 0))
    assert np.allclose(colours[5, 10], 0, atol=0.02)
    assert np.allclose(colours[5, 19], 1, atol=0.02)
    assert lengths[5, 10:20].tolist() == [1, 2, 3, 4, 5, 5, 4, 3, 2, 1]
    assert np.isinf(lengths[5, :10]).all()


def test_the_sign_of_a_direction_does_not_matter():
    rng = np.random.default_rng(0)
    signs = rng.choice([-1, 1], (32, 40, 1)).astype(np.float32)
    for there, back in zip(traced((1, 0)), traced(signs * np.float32([1, 0])), strict=True):
        assert np.allclose(there, back)


def test_lines_without_an_end_or_beyond_their_limit_carry_nothing():
    for colours, lengths in (traced((0, 1)), traced((1, 0), limit=0.5)):
        assert np.isinf(lengths).all()
        assert (colours == 0).all()


def test_one_thread_gives_the_same_bytes_as_three(monkeypatch):
    angle = np.random.default_rng(0).uniform(0, np.pi, (32, 40))
    field, results = np.stack([np.cos(angle), np.sin(angle)], axis=-1), []
    for threads in (1, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        results.append(b"".join(array.tobytes() for array in traced(field)))
    assert results[0] == results[1]
