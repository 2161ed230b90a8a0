"""From the landmarks of picture after picture to packets that drive one avatar."""

from __future__ import annotations

import numpy as np

from cap4d.drive.face_solver import Face, FaceSolver, Sight, look
from cap4d.drive.landmark_head import LandmarkHead
from cap4d.drive.neutral import Neutral
from cap4d.drive.one_euro import OneEuro
from cap4d.drive.packet import Packet
from cap4d.rotation import rotmat_to_axis_angle

GONE = 2.0  # s without a face after which whoever comes is taken for somebody else
SHOULDERS = 8.0  # s in which shoulders follow the head
MAX_BEND = 0.5  # rad of the neck
EXPR = (2.0, 12.0, 8.0)  # cut-off Hz, Hz per unit and second, Hz: see `OneEuro`
GAZE = (2.0, 12.0, 8.0)  # the same per rad
POSE = (1.5, 8.0, 4.0)  # the same per rad and per 0.1 m
METRES = 0.1  # of translation weigh as much as 1 rad


class FaceDriver:
    """One person in front of one camera, driving one avatar.

    Args:
        head: The avatar's.
    """

    def __init__(self, head: LandmarkHead) -> None:
        self.rig_name = head.subject.rig_name
        self.solver = FaceSolver(head)
        self.neutral = Neutral(self.solver)
        self._filters = {"expr": OneEuro(*EXPR), "gaze": OneEuro(*GAZE), "pose": OneEuro(*POSE)}
        self._shoulders: np.ndarray | None = None
        self._last = -np.inf

    def __call__(self, points: np.ndarray, width: int, height: int, t: float) -> Packet | None:
        """Drives by a picture's landmarks.

        Args:
            points: float[478, 2] px.
            width, height: Of the picture, px.
            t: s; pictures come in order.
        Returns:
            None where the landmarks are no face.
        """
        sight = look(points, width, height)
        if sight is None:
            return None
        if t - self._last > GONE:
            self._restart()
        try:
            return self._solved(sight, t)
        except np.linalg.LinAlgError:  # a face so odd that nothing can be solved for: the next one is another
            self.solver.reset()
            return None

    def _solved(self, sight: Sight, t: float) -> Packet | None:
        self.neutral.before(sight, t)
        face = self.solver(sight, self.neutral.offset)
        if face is None:
            return None
        self.neutral.after(sight, face, t)
        packet = self._packet(face, t)
        self._last = t
        return packet

    def _restart(self) -> None:
        self.solver.reset()
        self.neutral.restart()
        self._shoulders = None
        for smooth in self._filters.values():
            smooth.reset()

    def _packet(self, face: Face, t: float) -> Packet:
        neck = self._neck(face.rotmat, t)
        pose = np.concatenate([rotmat_to_axis_angle(face.rotmat), face.tra / METRES, neck])
        expr, gaze, pose = (
            self._filters[name](value, t).astype(np.float32)
            for name, value in (("expr", face.expr), ("gaze", face.gaze), ("pose", pose))
        )
        return Packet(
            t,
            self.rig_name,
            expr=expr,
            eye_rot=np.float32([*gaze, 0]),
            neck_rot=pose[6:],
            rot=pose[:3],
            tra=pose[3:6] * np.float32(METRES),
        )

    def _neck(self, rotmat: np.ndarray, t: float) -> np.ndarray:
        """[3] rad: the head turns over shoulders that stay; a head that stays turned takes them along."""
        if self._shoulders is None:
            self._shoulders = rotmat
        share = np.clip((t - self._last) / SHOULDERS, 0, 0.1)
        u, _, vt = np.linalg.svd(self._shoulders + share * (rotmat - self._shoulders))
        self._shoulders = u @ vt
        neck = rotmat_to_axis_angle(rotmat.T @ self._shoulders)
        return neck * min(1, MAX_BEND / max(np.linalg.norm(neck), 1e-9))
