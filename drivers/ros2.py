"""ROS 2 topics in the roles of drivers.base: images, the holder's poses, an operator's words, the registration out.

Header stamps become ``Stamp.device_s``; a message without a header, or with a time of zero, is stamped on arrival.

What is published of a registration (lengths in metres, as REP-103 says):

| topic | type | when |
|---|---|---|
| ``/fgreg/verdict`` | String | always: JSON: ``verdict``, ``reasons``, ``stage_deg``, ``plane_deg``, ``sigma_deg`` |
| ``/tf``, or ``/tf_static`` | TFMessage | usable: ``camera`` in ``trus`` |
| ``/fgreg/registration`` | PoseWithCovarianceStamped | usable: the same, with its covariance |

A refused registration is on the first topic only, and who listens to ``/tf_static`` from then on gets no transform.
Receivers keep the last transform that they got: the verdict says that it is out of date.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from fgreg.drivers import ros2_messages as ros
from fgreg.drivers.base import (
    CommandKind,
    DeviceLost,
    MotionSample,
    OperatorCommand,
    RefusedWord,
    Registration,
    host_now,
)
from fgreg.drivers.endoscope import Endoscope, EndoscopeConfig, InputConfig, Layout
from fgreg.drivers.igtl_registration import USABLE, angles_deg, usable_verdict, verdict_text
from fgreg.drivers.operator_words import asked
from fgreg.drivers.peer_words import PeerWords, check_words
from fgreg.drivers.ros2_stream import Topic
from fgreg.drivers.ros2_transport import Transport, check, open_transport
from fgreg.drivers.ros_messages import info_of, picture_of, pose_of
from fgreg.drivers.word_queue import WordQueue
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, adjoint, as_float_array, inverse
from fgreg.model.time_sync import Stamp

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, MotionSource, Operator, StereoCamera, TransformSink
    from fgreg.drivers.options import (
        Ros2CameraOptions,
        Ros2MotionOptions,
        Ros2OperatorOptions,
        Ros2SinkOptions,
    )

WORDS = 4096
"""Words that the link holds, at most: none of a burst may push out a stop."""
QUEUE = 8
"""Pictures of one camera that wait, at most."""


def _each(use: Callable[[Any], Any]) -> Callable[[Any], Iterable[tuple[Any, Any]]]:
    """A reader of messages that hold one item."""
    return lambda message: [(message, use(message))]


class Ros2Camera(Endoscope):
    """A StereoCamera: one or two image topics, decoded beside ``poll``, matched by the times in their headers.

    Raises:
        MissingExtraError, FgregError: as :func:`open_transport`.
    """

    def __init__(self, options: Ros2CameraOptions, context: DriverContext | None = None) -> None:
        self._transport = open_transport(options, ros.hash_of)
        names = [options.left, *([options.right] if options.right else [])]
        silence_s, delay_s = options.silence_s, options.delay_s
        topics = [
            Topic(self._transport, name, image_kind(name), _each(picture_of), silence_s, QUEUE, delay_s)
            for name in names
        ]
        inputs = [InputConfig(name) for name in names]
        config = EndoscopeConfig(
            inputs[0],
            inputs[1] if options.right else None,
            Layout.SEPARATE if options.right else Layout.MONO,
            max_gap_s=options.max_gap_s,
            queue=QUEUE,
        )
        super().__init__(config, None if context is None else context.rectified, topics)
        self._said = ""
        self._say = None if context is None else context.say
        self._info = options.info and Topic(self._transport, options.info, ros.INFO, _each(self._read_info), None, 1)

    def close(self) -> None:
        """End the connection."""
        super().close()
        if isinstance(self._info, Topic):
            self._info.close()
        self._transport.close()

    def _read_info(self, message: Any) -> None:
        """Tell once what the camera's node says of its calibration, to be compared with session.yaml."""
        if self._say is None or self._said:
            return
        try:
            info = info_of(message, "CameraInfo")
        except InputError as error:
            self._said = f"the camera cannot be used as calibrated: {error}"
        else:
            (width, height), k = info.image_size, info.matrix
            self._said = (
                f"CameraInfo of the left camera: {width} x {height} px, focal lengths {k[0, 0]:.1f} and {k[1, 1]:.1f} "
                f"px, centre {k[0, 2]:.1f}, {k[1, 2]:.1f} px; the registration uses those of session.yaml"
            )
        self._say(self._said)


class _Ros2Source:
    """A device of one topic."""

    _role = ""

    def __init__(self, transport: Transport, topic: Topic) -> None:
        self._transport, self._topic = transport, topic

    @property
    def name(self) -> str:
        """The topic."""
        return self._topic.name

    @property
    def connected(self) -> bool:
        """Whether messages come; of an operator, whether someone publishes."""
        return self._topic.connected

    @property
    def dropped(self) -> int:
        """Number of messages that were not fetched in time."""
        return self._topic.dropped

    @property
    def rejected(self) -> int:
        """Number of messages left out: of another type, invalid, overtaken."""
        return self._topic.rejections.count

    @property
    def last_rejection(self) -> str:
        """Why the last one was left out."""
        return f"{self.name}: {self._topic.rejections.last}"

    def close(self) -> None:
        """End the connection."""
        self._topic.close()
        self._transport.close()

    def _items(self) -> list[tuple[Stamp, Any]]:
        try:
            return [(item.stamp, item.picture) for item in self._topic.poll()]
        except DeviceLost as error:
            raise DeviceLost(f"{self._role}: {error}") from None


class Ros2Motion(_Ros2Source):
    """MotionSource: CRTK's ``measured_cp``, or two frames of ``/tf`` (all edges between them, also of ``/tf_static``).

    Left out and counted: poses that are not rigid or finite.
    """

    _role = "motion source"

    def __init__(self, options: Ros2MotionOptions) -> None:
        check_motion(options)
        self._tip_T_camera = as_float_array(np.eye(4) if options.tip_T_camera is None else options.tip_T_camera, 4, 4)
        transport = open_transport(options, ros.hash_of)
        of_tree = options.topic.endswith("/tf")
        kind, read = f"geometry_msgs/msg/{options.type}", _each(pose_of)
        self._fixed: Topic | None = None
        if of_tree:
            tree = ros.FrameTree(str(options.base), str(options.tip))

            def read(message: Any) -> Iterable[tuple[Any, Any]]:
                return [(stamped, (pose, None)) for stamped, pose in tree.take(message.transforms)]

            self._fixed = Topic(transport, f"{options.topic}_static", ros.TF, read, None, latched=True)
            kind = ros.TF
        super().__init__(transport, Topic(transport, options.topic, kind, read, options.silent_s))

    def poll(self) -> list[MotionSample]:
        """Samples since the last call. Raises DeviceLost."""
        tip_from_camera = adjoint(inverse(self._tip_T_camera))
        out = []
        for stamp, (pose, covariance) in self._items():
            if covariance is not None:
                covariance = as_float_array(tip_from_camera @ covariance @ tip_from_camera.T)
            out.append(MotionSample(stamp, as_float_array(pose @ self._tip_T_camera), covariance))
        return out

    def close(self) -> None:
        """End the connection."""
        if self._fixed is not None:
            self._fixed.close()
        super().close()


class Ros2Operator(_Ros2Source):
    """An Operator whose commands are String messages; messages to it, and replies, are String messages too.

    Words are read as they arrive, into a queue in which a stop has a place of its own.
    """

    _role = "operator"

    def __init__(self, options: Ros2OperatorOptions, words: PeerWords | None = None) -> None:
        transport = open_transport(options, ros.hash_of)
        self._peer, self._words, self._queue = options.topic, words or PeerWords(), WordQueue()
        self._send = transport.publisher(options.answers, ros.TEXT)
        topic = Topic(transport, options.topic, ros.TEXT, _each(self._heard), None, WORDS, at_once=True)
        super().__init__(transport, topic)

    @property
    def dropped(self) -> int:
        """Number of words dropped because they were not fetched in time."""
        return self._queue.dropped

    def poll(self) -> list[OperatorCommand | RefusedWord]:
        """Words since the last call. Raises DeviceLost, after the words that came before the loss."""
        words = self._queue.take()
        if not words:
            self._items()  # the same messages: the queue has their words
        return words

    def _heard(self, message: Any) -> None:
        """A message, in the link's thread. Raises ValueError for a word that is not understood."""
        word = self._words.take(str(message.data), self._peer, host_now(), time.time())
        if isinstance(word, str):
            self._answer(word)
            raise ValueError(word)
        self._queue.put(word)
        if isinstance(word, RefusedWord):
            self._answer(word.text)

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """Send a message."""
        self._answer(asked(text, wants))

    def _answer(self, text: str) -> None:
        with contextlib.suppress(DeviceLost):  # as for any receiver that is not there
            self._send(ros.text(text))


class Ros2Sink:
    """TransformSink: what is published when, the module says. It is lost when no one listens any more."""

    def __init__(self, options: Ros2SinkOptions) -> None:
        self._options = options
        self._transport = open_transport(options, ros.hash_of)
        self.name = "/tf_static" if options.static else "/tf"
        self._send_transform = self._transport.publisher(self.name, ros.TF, latched=options.static)
        self._send_pose = self._transport.publisher(options.registration, ros.POSE_COVARIANCE)
        self._send_verdict = self._transport.publisher(options.verdict, ros.TEXT)
        self._heard = False

    @property
    def connected(self) -> bool:
        """Whether someone listens to one of the topics."""
        names = self.name, self._options.registration, self._options.verdict
        return any(self._transport.subscribers(name) for name in names)

    @property
    def dropped(self) -> int:
        """0: what a receiver does not take is dropped on its way, and not counted."""
        return 0

    def send(self, registration: Registration) -> None:
        """Publish the registration. Raises DeviceLost once all receivers are gone."""
        verdict, reasons = usable_verdict(registration)
        pose = registration.trus_T_camera
        unix_s = max(time.time() - (host_now() - registration.stamp.host_s), 0.0)
        angles = angles_deg(registration) if verdict in USABLE else {}
        self._send_verdict(ros.text(verdict_text(verdict, angles, reasons)))
        if verdict in USABLE and pose is not None:
            parent, child = self._options.parent, self._options.child
            self._send_transform(ros.transform_message(pose, parent, child, unix_s))
            self._send_pose(ros.pose_message(pose, _finite(registration.covariance), parent, unix_s))
        else:
            self._send_transform(None)  # whom the static one would reach later must not get it any more
        was, self._heard = self._heard, self.connected
        if was and not self._heard:
            raise DeviceLost(f"transform sink: {self.name}: no one listens any more")

    def close(self) -> None:
        """End the connection."""
        self._transport.close()


def _finite(covariance: FloatArray | None) -> FloatArray | None:
    return covariance if covariance is not None and np.isfinite(covariance).all() else None


def image_kind(topic: str) -> str:
    """Type of an image topic, by image_transport's naming."""
    return ros.COMPRESSED if topic.endswith("/compressed") else ros.IMAGE


def check_motion(options: Ros2MotionOptions) -> None:
    """Raises ValueError: /tf without its frames; MissingExtraError, FgregError: no way to ROS 2."""
    of_tree = options.topic.endswith("/tf")
    if of_tree and not (options.base and options.tip):
        raise ValueError(f"of {options.topic}, base and tip have to be named")
    if not of_tree and (options.base or options.tip):
        raise ValueError(f"base and tip are for /tf; topic is {options.topic}")
    check(options)


def check_operator(options: Ros2OperatorOptions) -> None:
    """Raises FieldError, InputError: words or key; MissingExtraError, FgregError: no way to ROS 2."""
    check_words(options.words, options.key)
    check(options)


def open_camera(context: DriverContext, options: Ros2CameraOptions) -> StereoCamera:
    """Images of ROS 2 topics."""
    return Ros2Camera(options, context)


def open_motion(_context: DriverContext, options: Ros2MotionOptions) -> MotionSource:
    """Poses of the endoscope's holder."""
    return Ros2Motion(options)


def open_operator(context: DriverContext, options: Ros2OperatorOptions) -> Operator:
    """Texts over ROS 2. Raises InputError for a key that cannot be used."""
    return Ros2Operator(options, PeerWords.of(options.words, options.key, context.corners))


def open_sink(_context: DriverContext, options: Ros2SinkOptions) -> TransformSink:
    """Receivers of the registration."""
    return Ros2Sink(options)
