"""A wide camera with each of the lens models, and OpenCV's own projection."""

from __future__ import annotations

import cv2
import numpy as np

from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import CameraModel

WIDE = as_float_array([[600.0, 0.0, 640.0], [0.0, 605.0, 360.0], [0.0, 0.0, 1.0]])
LENSES = {
    name: CameraModel((1280, 720), WIDE, as_float_array(distortion), fisheye)
    for name, distortion, fisheye in (
        ("four", [-0.1, 0.06, 0.001, -0.002], False),
        ("five", [-0.35, 0.15, 0.002, -0.001, -0.02], False),
        ("rational", [0.5, -2.7, 0.0007, -0.0002, 1.6, 0.38, -2.5, 1.5], False),
        ("prism", [-0.1, 0.06, 0.001, -0.002, 0.01, 0.02, 0.03, 0.001, 0.002, 0.001, -0.001, 0.002], False),
        ("fisheye", [0.1, -0.05, 0.01, 0.002], True),
    )
}


def opencv_pixels(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in the camera's frame, by OpenCV."""
    see = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    pixels, _ = see(camera_p_mm[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
