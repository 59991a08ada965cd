"""Videos: real times, random access, gray and colour, and what FFmpeg makes of broken files."""

import pickle
import subprocess
import sys
from typing import Any

import av
import numpy as np
import pytest
import torch
from av.video.frame import VideoFrame
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.io import video as video_module
from sonosweep.io.video import read_video
from sonosweep.io.video_write import write_video

from .damage import LARGEST_RESIDENT_MB, assert_reads_or_explains, damaged, resident_mb_after

MKV_TICK_S = 1e-3  # Matroska counts milliseconds
MP4_TICK_S = 1 / 90_000
CODING_LEVELS = 14  # largest error of a coarse codec on the ramps below
ROUNDING_LEVELS = 3  # RGB to YUV and back, 8 bits each


def ramps(count: int = 30, rows: int = 49, columns: int = 63) -> np.ndarray:
    """Frames that a lossy codec keeps well and that all differ: a gradient that gets brighter."""
    levels = np.arange(count)[:, None, None] * 5 + np.arange(columns)[None, None, :]
    return np.broadcast_to(levels, (count, rows, columns)).astype(np.uint8)


def speckle(count: int = 8, rows: int = 33, columns: int = 41) -> np.ndarray:
    """Frames that only a lossless codec keeps."""
    return np.random.default_rng(0).integers(0, 256, (count, rows, columns), dtype=np.uint8)


def irregular(count: int) -> torch.Tensor:
    """Times of a scanner that stutters."""
    gaps = torch.tensor([0.041, 0.04, 0.097, 0.02], dtype=torch.float64).repeat(count)[:count]
    return gaps.cumsum(0) + 100.0


def encode(path, codec: str, layout: str, frames: np.ndarray, **options: str) -> None:
    """Write a video of a given codec, 25 frames/s, as other programs would."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=25)  # a video stream, for these codecs
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt, stream.options = layout, options
        for i, frame in enumerate(frames):
            picture = VideoFrame.from_ndarray(frame, format="gray").reformat(format=layout)
            picture.pts = i
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(("suffix", "tick_s"), [(".mkv", MKV_TICK_S), (".mp4", MP4_TICK_S)])
def test_lossless_video_gives_back_pixels_and_times(tmp_path, suffix, tick_s):
    """Speckle survives bit by bit, and irregular times to the unit of the container."""
    path, times = tmp_path / f"sweep{suffix}", irregular(8)

    write_video(speckle(), times, path)
    scan = read_video(path)

    np.testing.assert_array_equal(scan.frames[:], speckle())
    assert (scan.name, scan.frames.dtype, scan.frames.shape) == ("sweep", np.uint8, (8, 33, 41))
    torch.testing.assert_close(scan.timestamps_s, times - times[0], atol=tick_s, rtol=0)


def test_a_small_file_loses_little(tmp_path):
    """With crf, H.264 keeps a smooth image within a few levels, at a tenth of the size."""
    write_video(ramps(), None, tmp_path / "small.mp4", crf=18)

    frames = read_video(tmp_path / "small.mp4").frames[:]

    assert np.abs(frames.astype(int) - ramps()).max() < CODING_LEVELS
    assert (tmp_path / "small.mp4").stat().st_size < ramps().size / 10


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_colour_stays_colour(tmp_path, suffix):
    """A frame with one coloured mark is RGB; FFV1 keeps it exactly."""
    colour = np.repeat(ramps(4)[..., None], 3, axis=-1)
    colour[:, 5:9, 5:9] = 255, 0, 0

    write_video(colour, None, tmp_path / f"colour{suffix}")
    scan = read_video(tmp_path / f"colour{suffix}")

    assert scan.frames.shape == (4, 49, 63, 3)
    assert np.abs(scan.frames[:].astype(int) - colour).max() <= (
        0 if suffix == ".mkv" else ROUNDING_LEVELS
    )
    assert read_video(tmp_path / f"colour{suffix}", gray=True).frames.shape == (4, 49, 63)


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_the_same_frames_give_the_same_bytes(tmp_path, suffix):
    """No date and no random number is in the file."""
    for name in ("a", "b"):
        write_video(speckle(), irregular(8), tmp_path / f"{name}{suffix}", crf=20)

    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


OTHERS = [
    ("a.avi", "mjpeg", "yuvj420p", {}),
    ("b.avi", "rawvideo", "bgr24", {}),
    ("c.avi", "mpeg4", "yuv420p", {"bf": "2"}),
    ("d.avi", "libx264", "yuv420p", {"g": "7"}),
    ("e.mpg", "mpeg2video", "yuv420p", {"g": "6"}),
    ("f.wmv", "wmv2", "yuv420p", {}),
    ("g.ts", "libx264", "yuv420p", {"g": "7"}),
    ("h.webm", "libvpx-vp9", "yuv420p", {"g": "9"}),
    ("i.mp4", "libx264", "yuv420p", {"g": "7", "bf": "3"}),
    ("j.mp4", "mpeg4", "yuv420p", {"bf": "2"}),
    ("k.mkv", "libx264", "yuv420p", {"g": "250", "bf": "3"}),
    ("l.mov", "qtrle", "rgb24", {}),
]


@pytest.mark.parametrize(("name", "codec", "layout", "options"), OTHERS)
def test_any_order_of_reading_gives_the_same_frames(tmp_path, name, codec, layout, options):
    """Forwards, backwards and at random, with and without B-frames, in every container."""
    truth = ramps(rows=48, columns=64)
    encode(tmp_path / name, codec, layout, truth, **options)

    scan = read_video(tmp_path / name)
    forwards = scan.frames[:]

    assert scan.frames.shape == (30, 48, 64)
    assert np.abs(forwards.astype(int) - truth).max() < CODING_LEVELS
    steps = scan.timestamps_s.diff()
    torch.testing.assert_close(steps, torch.full((29,), 0.04).double(), atol=MKV_TICK_S, rtol=0)
    order = [29, 0, 15, 14, 28, 3, *range(29, -1, -1), *np.random.default_rng(1).permutation(30)]
    for i in order:
        fresh = read_video(tmp_path / name).frames if i == 15 else scan.frames
        np.testing.assert_array_equal(fresh[int(i)], forwards[i])


def test_reading_in_order_decodes_each_frame_once(tmp_path, monkeypatch):
    """A sweep of N frames costs N decoded frames and no seek back."""
    encode(tmp_path / "long.mp4", "libx264", "yuv420p", ramps(rows=48, columns=64), g="10")
    frames = read_video(tmp_path / "long.mp4", gray=True).frames
    opened = []
    original = video_module.VideoFrames._start
    monkeypatch.setattr(
        video_module.VideoFrames,
        "_start",
        lambda self, tick: (opened.append(tick), original(self, tick))[1],
    )

    for i in range(30):
        frames[i]

    assert opened == [0]


def test_full_and_limited_range_mean_the_same(tmp_path):
    """Video of 16 to 235 and of 0 to 255 both come out as 0 to 255."""
    black_to_white = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (3, 48, 1))
    encode(tmp_path / "tv.mkv", "libx264", "yuv420p", black_to_white, qp="0")

    frame = read_video(tmp_path / "tv.mkv").frames[0]

    assert (int(frame.min()), int(frame.max())) == (0, 255)
    assert np.abs(frame.astype(int) - black_to_white[0]).max() <= ROUNDING_LEVELS


def test_frames_travel_to_another_process(tmp_path):
    """A data loader may pickle frames that were already read."""
    write_video(speckle(), None, tmp_path / "sweep.mkv")
    frames = read_video(tmp_path / "sweep.mkv").frames
    frames[3]

    again = pickle.loads(pickle.dumps(frames))

    np.testing.assert_array_equal(again[5], speckle()[5])
    with pytest.raises(IndexError):
        again[8]


def test_a_reader_owns_its_frame(tmp_path):
    """Painting over a frame does not change what is read next."""
    write_video(speckle(), None, tmp_path / "sweep.mkv")
    frames = read_video(tmp_path / "sweep.mkv").frames

    frames[2][:] = 0

    np.testing.assert_array_equal(frames[2], speckle()[2])


@pytest.mark.slow
def test_decoded_frames_are_not_kept(tmp_path):
    """Going through 150 frames of 2048 x 2048 decodes 630 MB and holds a tenth of it."""
    frame = np.zeros((1, 2048, 2048), np.uint8)
    frame[:, ::64] = 200
    still = np.broadcast_to(frame, (150, 2048, 2048))
    encode(tmp_path / "long.mp4", "libx264", "yuv420p", still, preset="ultrafast")

    used = resident_mb_after(
        "from sonosweep.io.video import read_video\n"
        "frames = read_video(path).frames\n"
        "assert len(frames) == 150 and all(frames[i].any() for i in range(150))",
        tmp_path / "long.mp4",
    )

    assert used < LARGEST_RESIDENT_MB


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": speckle().astype(np.uint16)}, "8-bit gray or RGB"),
        ({"frames": speckle()[:0]}, "no frames to write"),
        ({"path": "sweep.avi"}, "known are .mkv and .mp4"),
        ({"timestamps_s": torch.arange(7.0).double()}, "8 frames need as many times"),
        ({"timestamps_s": torch.zeros(8).double()}, "the same 1 ms"),
        ({"timestamps_s": torch.full((8,), torch.nan).double()}, "need as many times"),
        ({"crf": 90}, "crf must be"),
        ({"timestamps_s": None, "frame_rate_hz": 0.0}, "above 0 Hz"),
    ],
)
def test_what_cannot_become_a_video_is_said(tmp_path, arguments, message):
    """A message, and no file is left."""
    call = {"frames": speckle(), "timestamps_s": irregular(8), "path": "sweep.mkv", **arguments}

    with pytest.raises(FormatError, match=message):
        write_video(**{**call, "path": tmp_path / call["path"]})

    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_sentence(tmp_path):
    """When no more bytes can be written, nothing is left behind and the message says so."""
    program = (
        "import resource, signal, sys\nimport numpy as np\n"
        "from sonosweep.io.video_write import write_video\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "frames = np.random.default_rng(0).integers(0, 256, (60, 99, 99), dtype=np.uint8)\n"
        "for path in sys.argv[1:]:\n    try:\n        write_video(frames, None, path)\n"
        "    except Exception as error:\n        print(type(error).__name__, error)\n"
    )

    run = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.mkv"), str(tmp_path / "a.mp4")],
        capture_output=True,
        text=True,
        check=True,
    )

    assert [line.split()[0] for line in run.stdout.splitlines()] == ["FormatError", "FormatError"]
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_video_are_said(tmp_path):
    """A text, a playlist that would open other files, a stream without times, no file."""
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n")
    (tmp_path / "concat.mp4").write_text("ffconcat version 1.0\nfile /etc/hostname\n")
    encode(tmp_path / "raw.h264", "libx264", "yuv420p", ramps(rows=48, columns=64))

    for name in ("text.mp4", "list.mp4", "concat.mp4", "raw.h264", "none.mp4"):
        with pytest.raises(FormatError):
            read_video(tmp_path / name)


def test_an_unknown_codec_is_said(tmp_path):
    """The four letters that name the codec are damaged, or of a codec that is not there."""
    encode(tmp_path / "a.avi", "mjpeg", "yuvj420p", ramps(3, rows=48, columns=64))
    whole = (tmp_path / "a.avi").read_bytes().replace(b"MJPG", b"ZZZZ")
    (tmp_path / "a.avi").write_bytes(whole)

    with pytest.raises(FormatError, match="FFmpeg does not know"):
        read_video(tmp_path / "a.avi")


def test_a_cut_off_video_is_noticed(tmp_path):
    """Matroska plays up to where it ends; the notes say that something is missing."""
    frames = np.random.default_rng(0).integers(0, 256, (80, 49, 63), dtype=np.uint8)
    write_video(frames, None, tmp_path / "whole.mkv")
    whole = (tmp_path / "whole.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(whole[: len(whole) // 2])

    scan = read_video(tmp_path / "cut.mkv")

    assert "frames" not in read_video(tmp_path / "whole.mkv").notes
    assert "may have been cut off" in scan.notes["frames"]
    np.testing.assert_array_equal(scan.frames[10], frames[10])


def test_damage_inside_spoils_one_frame(tmp_path):
    """In our lossless files every frame stands for itself."""
    write_video(speckle(), None, tmp_path / "sweep.mkv")
    whole = bytearray((tmp_path / "sweep.mkv").read_bytes())
    whole[len(whole) // 2] ^= 0xFF
    (tmp_path / "sweep.mkv").write_bytes(whole)

    frames = read_video(tmp_path / "sweep.mkv").frames

    intact = [i for i in range(8) if np.array_equal(frames[i], speckle()[i])]
    assert len(intact) == 7


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """Small valid files of several kinds."""
    folder = tmp_path_factory.mktemp("whole")
    truth = ramps(6, rows=48, columns=64)
    write_video(truth, None, folder / "ffv1.mkv")
    write_video(truth, None, folder / "h264.mp4", crf=20)
    encode(folder / "mjpeg.avi", "mjpeg", "yuvj420p", truth)
    encode(folder / "mpeg2.mpg", "mpeg2video", "yuv420p", truth)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@given(data=st.data(), name=st.sampled_from(["ffv1.mkv", "h264.mp4", "mjpeg.avi", "mpeg2.mpg"]))
def test_damaged_videos_are_explained(tmp_path_factory, whole, data, name):
    """Bytes lost or changed anywhere give frames or a sentence, nothing else."""
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(data.draw(damaged(whole[name])))

    assert_reads_or_explains(lambda: read_video(path))


def test_of_two_frames_at_one_time_the_first_counts(tmp_path):
    """MPEG program streams can end so; the other one is left out and noted."""
    truth = ramps(rows=48, columns=64)
    encode(tmp_path / "sweep.mpg", "mpeg2video", "yuv420p", truth, g="6", bf="2")

    scan = read_video(tmp_path / "sweep.mpg")
    forwards = scan.frames[:]

    assert len(scan.frames) == 29
    assert scan.notes["times"].startswith("1 frames are left out")
    assert np.abs(forwards.astype(int) - truth[:29]).max() < CODING_LEVELS
    for i in (28, 27, 0, 28):
        np.testing.assert_array_equal(scan.frames[i], forwards[i])
