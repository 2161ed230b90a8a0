"""A real person on video becomes a capture that lies on the person."""

import av
import numpy as np
import pytest

for module in ("OpenImageIO", "torch", "cv2", "mediapipe"):
    pytest.importorskip(module, reason="needs the extra [track] and mediapipe")

from cap4d.capture.capture import Capture  # noqa: E402
from cap4d.rig.ict import import_ict  # noqa: E402
from cap4d.track import track  # noqa: E402

FRAMES = 20


def _beginning(source, target, frames):
    with av.open(str(source)) as video, av.open(str(target), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.width, stream.height = video.streams.video[0].width, video.streams.video[0].height
        stream.pix_fmt = "yuv420p"
        for _, frame in zip(range(frames), video.decode(video=0), strict=False):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame.to_ndarray(format="rgb24"))))
        container.mux(stream.encode())


@pytest.mark.slow
def test_talking_head_is_tracked(shared, tmp_path):
    _beginning(shared / "video" / "talking_head.mp4", tmp_path / "start.mp4", FRAMES)
    rig = import_ict(shared / "ict" / "ict_facekit_light.npz")
    report = track(tmp_path / "start.mp4", rig, tmp_path / "capture")
    assert (report.frames, report.tracked) == (FRAMES, FRAMES)
    assert report.median_error <= 2.5
    capture = Capture.load(tmp_path / "capture")
    assert capture.image(capture.views[-1]).shape == (512, 512, 3)
    assert (tmp_path / "capture" / "overlay.mp4").stat().st_size > 10_000
    assert np.abs(np.diff(capture.rot, 2, axis=0)).max() < 0.02  # rad per frame^2: no jumps
    matte = capture.matte(capture.views[0])
    assert 0.3 < matte.mean() < 0.7 and matte[300, 256] == 1 and matte[100, 480] < 0.05
