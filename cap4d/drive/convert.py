"""A packet in its sender's terms -> a frame of the avatar's own expressions."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.arkit import ArkitMap, arkit_map
from cap4d.drive.clip import Frame
from cap4d.drive.flame_editions import EditionMap, convert_expression, same_basis
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.drive.retarget import Retargeter
from cap4d.drive.vertices import expected_vertices, read_template
from cap4d.errors import ArgumentError
from cap4d.rig.flame import RELEASED_RIG
from cap4d.rig.head import HeadRig

log = logging.getLogger(__name__)

MAX_RESIDUAL_MM = (
    15.0  # root mean square; a face that talks is within one or two, another person's within ten
)
MAX_OFFSET = 0.5  # m of a vertex from the neutral face: beyond it the mesh is in other units or another place
REACH = 2.0  # expressions are kept within their range and this many times its width beyond
MAX_COMPONENT = 15.0  # of another FLAME's expressions, which have unit variance
MAX_TURN = np.pi  # rad
MAX_WEIGHT = 2.0  # of Apple's, which are 0 to 1
MAX_DISTANCE = np.float32(100.0)  # m
TURNS = ("eye_rot", "neck_rot", "jaw_rot")


class Converter:
    """Packets -> frames. For one thread at a time.

    Expressions far beyond their ranges are brought back to where a face can still be drawn; turns to half a
    turn.

    Args:
        bundle: The avatar.
        template: Neutral vertices of whoever sends vertices: float32[V, 3] m or a file, see `read_template`;
            None: their first frame is taken for it.
        sender: The rig of whoever sends expressions of another edition of FLAME; None: those are refused.
    Raises:
        ArgumentError, DataError: The template is of another topology, or not sound.

    Attributes:
        residual_mm: What the last frame of vertices, or of another edition, moved beyond what the avatar's
            expressions can, root mean square over its points; None before the first.
    """

    def __init__(
        self, bundle: Bundle, *, template: np.ndarray | Path | None = None, sender: HeadRig | None = None
    ) -> None:
        self._bundle = bundle
        self._names = bundle.subject.expression_names
        low, high = bundle.expression_range.T.astype(np.float32)
        self._low, self._high = low - REACH * (high - low), high + REACH * (high - low)
        self._arkit: ArkitMap | str | None = None  # a text: why there is none
        self._retargeter: Retargeter | str | None = None
        self._edition = None if sender is None else EditionMap(sender, bundle)
        self._template = self._read(template)
        self.residual_mm: float | None = None
        if self._template is not None:
            self._vertex_map()  # now, so that the first frame need not wait for it

    def __call__(self, packet: Packet) -> Frame:
        """The frame.

        Raises:
            Rejected: RIG, the avatar has no way from what was sent; SHAPE, not its number of values;
                NOT_FINITE; RETARGET, vertices that are no face of its topology.
        """
        if packet.vertices is not None:
            expr, turns = self._from_vertices(packet.vertices)
        elif packet.arkit is not None:
            expr, turns = self._from_arkit(packet.arkit)
        else:
            (expr, packet), turns = self._from_expressions(packet), {}
        return self._frame(packet, expr, turns)

    def neutral(self, t: float = 0.0) -> Frame:
        """The face at rest: the rig's neutral, but its lips closed where a FLAME's are not."""
        zeros = np.zeros(3, np.float32)
        expr, _, jaw_rot = self._at_rest()
        return Frame(t, self._bundle.rig_name, expr, zeros, zeros, jaw_rot)

    def _frame(self, packet: Packet, expr: np.ndarray, turns: dict[str, np.ndarray]) -> Frame:
        for name in TURNS:
            given = getattr(packet, name)
            if given is not None:
                turns[name] = given
        rot, tra = packet.rot, packet.tra
        if rot is not None and tra is None:
            tra = np.zeros(3, np.float32)
        return Frame(
            packet.t,
            self._bundle.rig_name,
            np.clip(_finite("expr", expr), self._low, self._high),
            **{name: _turn(name, turns.get(name)) for name in TURNS},
            rot=None if rot is None else _turn("rot", rot),
            tra=None if tra is None else np.clip(_finite("tra", tra, 3), -MAX_DISTANCE, MAX_DISTANCE),
        )

    def _from_expressions(self, packet: Packet) -> tuple[np.ndarray, Packet]:
        """The avatar's expressions, and the packet less a jaw that they have taken over."""
        if packet.expr is None or packet.expr.ndim != 1:
            raise Rejected(Cause.FIELD, "expr: expected a list of numbers")
        rig_name = packet.rig_name or RELEASED_RIG  # what names no rig is the released system's (fact 46)
        edition, target = self._edition, self._bundle.rig_name
        if edition is None or edition.rig_name != rig_name or same_basis(rig_name, target):
            return convert_expression(packet.expr, rig_name, target, self._names), packet
        if not 0 < len(packet.expr) <= edition.n_expressions:
            expected = f"expr: expected at most {edition.n_expressions} numbers"
            raise Rejected(Cause.SHAPE, f"{expected}, got {len(packet.expr)}")
        jaw_rot = _turn("jaw_rot", packet.jaw_rot)
        sent = np.clip(_finite("expr", packet.expr), -MAX_COMPONENT, MAX_COMPONENT)
        expr, self.residual_mm = edition(sent, jaw_rot)
        return expr, packet if edition.keeps_jaw else replace(packet, jaw_rot=None)

    def _from_arkit(self, weights: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        arkit = self._arkit_map()
        if weights.shape != (arkit.expr.shape[1],):
            raise Rejected(
                Cause.SHAPE, f"arkit: expected {arkit.expr.shape[1]} weights, got {list(weights.shape)}"
            )
        weights = np.clip(_finite("arkit", weights), -MAX_WEIGHT, MAX_WEIGHT)
        expr, eye_rot, jaw_rot = arkit(weights)
        return expr, {"eye_rot": eye_rot, "jaw_rot": jaw_rot}

    def _from_vertices(self, vertices: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        retargeter = self._vertex_map()
        if vertices.shape != (retargeter.count, 3):
            raise Rejected(
                Cause.SHAPE, f"vertices: expected {retargeter.count} points, got {list(vertices.shape)}"
            )
        _finite("vertices", vertices)
        if self._template is None:
            log.warning("no template given: the first frame of vertices is taken for the neutral face")
            self._template = _moderate(vertices)
        if np.abs(vertices - self._template).max() > MAX_OFFSET:
            raise Rejected(
                Cause.RETARGET, f"vertices: expected metres, within {MAX_OFFSET} m of the neutral face"
            )
        found = retargeter(vertices[None], self._template)
        residual_mm = float(found.residual_mm[0])
        if not residual_mm <= MAX_RESIDUAL_MM:
            raise Rejected(Cause.RETARGET, f"vertices: {residual_mm:.1f} mm from any face of the avatar's")
        self.residual_mm = residual_mm
        return found.expr[0], {"eye_rot": found.eye_rot[0]}

    def _arkit_map(self) -> ArkitMap:
        if self._arkit is None:
            try:
                self._arkit = arkit_map(self._bundle)
            except ArgumentError as error:
                self._arkit = str(error)
        if isinstance(self._arkit, str):
            raise Rejected(Cause.RIG, self._arkit)
        return self._arkit

    def _at_rest(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        try:
            arkit = self._arkit_map()
        except Rejected:
            return np.zeros(len(self._names), np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
        return arkit(np.zeros(arkit.expr.shape[1], np.float32))

    def prepare(self) -> None:
        """Works out now what the first frame of vertices would wait for (0.15 s), and those behind it."""
        with suppress(Rejected):
            self._vertex_map()

    def _vertex_map(self) -> Retargeter:
        if self._retargeter is None:
            try:
                self._retargeter = Retargeter(self._bundle, expected_vertices(self._bundle))
            except ArgumentError as error:
                self._retargeter = str(error)
        if isinstance(self._retargeter, str):
            raise Rejected(Cause.RETARGET, self._retargeter)
        return self._retargeter

    def _read(self, template: np.ndarray | Path | None) -> np.ndarray | None:
        count = expected_vertices(self._bundle)
        if isinstance(template, np.ndarray):
            if template.shape != (count, 3) or not np.isfinite(template).all():
                expected = f"template: expected finite float32[{count}, 3]"
                raise ArgumentError(f"{expected}, got {template.dtype}{list(template.shape)}")
            return template.astype(np.float32)
        return None if template is None else read_template(Path(template), count)


def _finite(name: str, value: np.ndarray, count: int | None = None) -> np.ndarray:
    if count is not None and value.shape != (count,):
        raise Rejected(Cause.SHAPE, f"{name}: expected {count} numbers, got {list(value.shape)}")
    with np.errstate(over="ignore"):
        value = value.astype(np.float32, copy=False)
    if not np.isfinite(value).all():
        raise Rejected(Cause.NOT_FINITE, f"{name}: expected finite numbers")
    return value


def _turn(name: str, rotvec: np.ndarray | None) -> np.ndarray:
    """float32[3], of at most half a turn; None is none."""
    if rotvec is None:
        return np.zeros(3, np.float32)
    rotvec = _finite(name, rotvec, 3)
    length = np.linalg.norm(rotvec.astype(np.float64))
    return rotvec if length <= MAX_TURN else (rotvec / length * MAX_TURN).astype(np.float32)


def _moderate(vertices: np.ndarray) -> np.ndarray:
    """The vertices, if they may be a head in metres."""
    size = float((vertices.max(0).astype(np.float64) - vertices.min(0)).max())
    if not 0.05 <= size <= 2:
        raise Rejected(Cause.RETARGET, f"vertices: expected a head in metres, got one of {size:.3g} m")
    return vertices.astype(np.float32)
