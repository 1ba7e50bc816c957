"""Edges of a black square: unbiased under blur and uneven light, and no edge where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from fgreg.detection.corners import square_corners
from fgreg.detection.edge_pixels import EdgePixels
from fgreg.detection.edges import fit_edges
from fgreg.detection.step_model import normal_cdf, step_model
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import CameraModel

PLAIN = CameraModel((400, 300), as_float_array([[800, 0, 0], [0, 800, 0], [0, 0, 1]]), as_float_array(np.zeros(5)))


def square_image(corners: FloatArray, blur_px: float, fall_off: float = 0.0, noise: float = 0.0) -> FloatArray:
    """A dark square in a light field as an ideal lens blurs it: product of the edges' blurred half planes."""
    y, x = np.mgrid[0:300, 0:400].astype(float)
    inside = np.ones_like(x)
    total = np.hypot(blur_px, np.sqrt(1 / 12))
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        d = (b - a) / np.linalg.norm(b - a)
        inside *= ndtr(-((x - a[0]) * d[1] - (y - a[1]) * d[0]) / total)
    light = 1.0 + fall_off * (x - 200)
    image = light * (170 - 150 * inside)
    return np.asarray(image + noise * np.random.default_rng(0).normal(size=image.shape))


def as_bytes(image: FloatArray) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


CORNERS = np.array([[101.3, 60.2], [261.7, 83.9], [240.4, 231.6], [88.8, 214.1]])


def test_step_model_jacobian_against_differences() -> None:
    rng = np.random.default_rng(0)
    zeros = np.zeros((2, 50))
    band = EdgePixels(rng.uniform(-4, 4, (2, 50)), rng.uniform(-1, 1, (2, 50)), zeros, *np.ones((2, 2, 50), dtype=bool))
    x = np.array([[0.3, -0.2, 0.1, 20, 3, 150, -5, 0.003, -0.03], [-0.3, 0.2, -0.3, 10, 1, 100, 5, -0.004, 0.02]])
    _, jacobian = step_model(band, x)
    for k in range(9):
        d = np.zeros(9)
        d[k] = 1e-5
        numeric = (step_model(band, x + d)[0] - step_model(band, x - d)[0]) / 2e-5
        assert np.abs(numeric - jacobian[:, k]).max() < 1e-7 * max(1.0, np.abs(numeric).max())


def test_step_model_is_the_blur_of_a_step_under_sloping_light() -> None:
    # Numerical convolution of (1 + g v) (B + (W - B) [v > 0]) with a Gaussian, at a few distances.
    b, w, g, s = 20.0, 160.0, 0.01, 1.3
    v = np.linspace(-30, 30, 600001)
    scene = (1 + g * v) * (b + (w - b) * np.heaviside(v, 0.5))
    d = np.array([-2.0, -0.5, 0.0, 0.7, 3.0])
    expected = [np.sum(scene * np.exp(-0.5 * ((v - e) / s) ** 2)) * (v[1] - v[0]) / (s * np.sqrt(2 * np.pi)) for e in d]
    band = EdgePixels(d[None], np.zeros((1, 5)), np.zeros((1, 5)), *np.ones((2, 1, 5), dtype=bool))
    model, _ = step_model(band, np.array([[0.0, 0.0, np.log(s), b, 0.0, w, 0.0, g, 0.0]]))
    assert model[0] == pytest.approx(expected, abs=1e-3)


def test_the_normal_distribution_in_single_precision() -> None:
    t = np.linspace(-12.0, 12.0, 2001).astype(np.float32)
    density = np.exp(-0.5 * t * t) * np.float32(1.0 / np.sqrt(2.0 * np.pi))
    assert np.abs(normal_cdf(t, density) - ndtr(t.astype(np.float64))).max() < 3e-7


def test_edges_of_the_next_picture_start_where_the_last_one_ended() -> None:
    start, end, cell = CORNERS, np.roll(CORNERS, -1, axis=0), np.full(4, 25.0)
    last = fit_edges(PLAIN, as_bytes(square_image(CORNERS, 1.0, noise=1.0)), start, end, cell).again
    for blur_px, off_px in ((1.0, 0.1), (1.3, 0.1), (1.0, 6.0)):  # the last one is beyond what it can start with
        image = as_bytes(square_image(CORNERS, blur_px, noise=1.0))
        off = np.array([off_px, -0.5 * off_px])
        fresh = fit_edges(PLAIN, image, start + off, end + off, cell)
        fit = fit_edges(PLAIN, image, start + off, end + off, cell, last)
        assert fit.good.all()
        assert np.abs(fit.line - fresh.line).max() < 2e-3
        assert fit.blur_px == pytest.approx(fresh.blur_px, rel=0.01)


@pytest.mark.parametrize("blur_px", [0.7, 1.2, 2.0])
@pytest.mark.parametrize("fall_off", [0.0, 0.0015])
def test_corners_are_unbiased(blur_px: float, fall_off: float) -> None:
    image = as_bytes(square_image(CORNERS, blur_px, fall_off, noise=1.0))
    found = square_corners(PLAIN, image, (CORNERS + 0.8)[None], 6)
    assert found.from_edges.all()
    assert np.abs(found.ideal_px[0] - CORNERS).max() < 0.025


def test_subpixel_refinement_pulls_corners_inwards_where_edges_do_not() -> None:
    image = as_bytes(square_image(CORNERS, 1.2))
    outward = CORNERS - CORNERS.mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    bias = []
    for edges in (False, True):
        found = square_corners(PLAIN, image, CORNERS[None], 6, edges=edges)
        bias.append(float(np.sum((found.ideal_px[0] - CORNERS) * outward, axis=1).mean()))
    assert bias[0] < -0.05
    assert abs(bias[1]) < 0.01


def test_covariance_predicts_the_scatter_of_an_edge() -> None:
    start, end = CORNERS, np.roll(CORNERS, -1, axis=0)
    clean = square_image(CORNERS, 1.0)
    rng = np.random.default_rng(4)
    lines, covariances = [], []
    for _ in range(60):
        fit = fit_edges(PLAIN, as_bytes(clean + 3.0 * rng.normal(size=clean.shape)), start, end, np.full(4, 25.0))
        assert fit.good[0]
        lines.append(fit.line[0])
        covariances.append(fit.covariance[0])
    predicted = np.mean(covariances, axis=0)
    scatter = np.cov(np.array(lines).T)
    ratio = np.diag(scatter) / np.diag(predicted)
    assert ((ratio > 0.5) & (ratio < 2.0)).all()


def test_detector_that_took_the_inner_outline_is_put_right() -> None:
    image = as_bytes(square_image(CORNERS, 1.0))
    inner = CORNERS + 10.0 * (CORNERS.mean(axis=0) - CORNERS) / 80.0
    found = square_corners(PLAIN, image, inner[None], 6)
    assert found.from_edges.all()
    assert np.abs(found.ideal_px[0] - CORNERS).max() < 0.02


def test_flat_grey_gives_no_corner() -> None:
    image = np.full((300, 400), 120, dtype=np.uint8)
    found = square_corners(PLAIN, image, CORNERS[None], 6)
    assert not found.found.any()
