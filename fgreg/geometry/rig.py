"""The rig's constants: quantities of probe, stage, camera and prints that are the same in every shot of a session."""

from __future__ import annotations

from enum import IntEnum


class Constant(IntEnum):
    """The constants, in their order in every vector of them; the value of each is its true less its declared value.

    Probe and stage (docs/model.md, section 3, derives how each enters a look):
        WINDOW_EDGE: half width of the sensitivity window, rad.
        RADIUS: of the element faces about the axis, mm. RANGE_OFFSET: added to every range, mm.
        SOUND_SPEED, PITCH: relative.
        ARRAY_OFFSET: of the array beside the axis, towards where a positive stage angle turns it, mm.
        TILT_IN_PLANE: elements at larger x are further from the axis, rad.
        TILT_RADIAL: about the radial direction; elements at larger x are further in the array offset's direction, rad.
        TILT_ELEVATION: of the image plane about the array, in the array offset's direction, rad.
        WINDOW_CENTRE: of the window against the image plane, as stage rotation, rad.
        BACKLASH: of the stage: how far it stays behind its reading in the direction of a sweep, rad.

    Camera and marker:
        MARKER_BIAS: three components along the camera's axes: measured less true position of the marker, mm.
        CAMERA_SCALE: all lengths of the camera's space (stereo baseline), relative.
        FOCAL: focal length of each camera, relative. CENTRE: principal points, px.
        STEREO_ROTATION, STEREO_TRANSLATION: right tangent of ``right_T_left``, rad and mm.
        TAG_SIZE, BOARD_SIZE: of the prints, relative.
        VIEW_BIAS: measured less true position of the marker along the part of its normal that is across the line of
            sight, per sine of the angle between them, mm.
    """

    WINDOW_EDGE = 0
    RADIUS = 1
    RANGE_OFFSET = 2
    SOUND_SPEED = 3
    PITCH = 4
    ARRAY_OFFSET = 5
    TILT_IN_PLANE = 6
    TILT_RADIAL = 7
    TILT_ELEVATION = 8
    WINDOW_CENTRE = 9
    BACKLASH = 10
    MARKER_BIAS_X = 11
    MARKER_BIAS_Y = 12
    MARKER_BIAS_Z = 13
    CAMERA_SCALE = 14
    FOCAL_LEFT = 15
    FOCAL_RIGHT = 16
    CENTRE_LEFT_X = 17
    CENTRE_LEFT_Y = 18
    CENTRE_RIGHT_X = 19
    CENTRE_RIGHT_Y = 20
    STEREO_ROTATION_X = 21
    STEREO_ROTATION_Y = 22
    STEREO_ROTATION_Z = 23
    STEREO_TRANSLATION_X = 24
    STEREO_TRANSLATION_Y = 25
    STEREO_TRANSLATION_Z = 26
    TAG_SIZE = 27
    BOARD_SIZE = 28
    VIEW_BIAS = 29


COUNT = len(Constant)
"""Number of constants."""
PROBE = slice(Constant.WINDOW_EDGE, Constant.MARKER_BIAS_X)
"""Constants that looks depend on."""
CAMERA = slice(Constant.MARKER_BIAS_X, COUNT)
"""Constants that marker poses and aimed-at spots depend on."""
