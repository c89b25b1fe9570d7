"""Small videos of policies: filmed without a screen, kept as H.264 beside a poster, shown in pages and notebooks without a network.

`film` runs one episode, `save` writes NAME.mp4 and its poster NAME.webp, `show_video` and `show_videos` put them into the page itself.
Only `save` needs a package that learners need not have, imageio-ffmpeg, which brings an encoder.
"""

from __future__ import annotations

import base64
import html
import subprocess
import tempfile
from pathlib import Path

import numpy as np

CRF = range(20, 45, 3)  # x264's quality, from good to poor
NARROWEST = 190  # pixels of a video that stands beside others
TOGETHER = """<p><button type="button" onclick="
const all = [...this.closest('.course-videos').querySelectorAll('video')];
const ready = all.map((video) => {
  video.pause();
  video.currentTime = 0;
  if (video.readyState > 2) return true;
  video.preload = 'auto';
  video.load();
  return new Promise((done) => video.addEventListener('canplay', done, {once: true}));
});
Promise.all(ready).then(() => all.forEach((video) => video.play()));
">Play all from the start</button></p>"""


def film(act, env, seed=0, max_steps=1000, fps=25):
    """Run one episode and keep what it looks like.

    Args:
      act: obs (*obs,) -> action (*act,), both arrays.
      env: a Gymnasium environment (not a vector of them) with render_mode="rgb_array".
      seed: of the episode.
      max_steps: at most so many steps.
      fps: frames a second to keep, of those that env.metadata["render_fps"] says there are.

    Returns: (frames (F, H, W, 3) uint8, the episode's return).
    Raises: ValueError if env has another render mode.
    """
    if env.render_mode != "rgb_array":
        raise ValueError(f"env must be made with render_mode='rgb_array', got {env.render_mode!r}")
    every = max(1, round(env.metadata.get("render_fps", fps) / fps))
    obs, _ = env.reset(seed=seed)
    frames, total = [env.render()], 0.0
    for step in range(1, max_steps + 1):
        obs, reward, terminated, truncated, _ = env.step(act(obs))
        total += float(reward)
        ended = terminated or truncated
        if step % every == 0 or ended:
            frames.append(env.render())
        if ended:
            break
    return np.stack(frames), total


def save(frames, path, fps=25, width=400, max_bytes=250_000, poster=0):
    """Write a video (H.264 in an MP4 file) and its poster (WebP), `width` pixels wide, under the same name.

    Args:
      frames: (F, H, W, 3) uint8.
      path: of the video, ending in .mp4.
      fps: frames a second.
      width: in pixels; even.
      max_bytes: quality is lowered until the video is no larger.
      poster: index of the frame that stands in the page before the video is started.

    Raises: ValueError if the frames are not of this form, or even the poorest quality is larger than max_bytes; RuntimeError if
      there is no encoder.
    """
    from PIL import Image

    path, frames = Path(path), np.ascontiguousarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not len(frames):
        raise ValueError(f"frames must be (F, H, W, 3) uint8 with at least one frame, got {frames.shape} {frames.dtype}")
    height = 2 * round(width * frames.shape[1] / frames.shape[2] / 2)
    for crf in CRF:
        content = _encoded(frames, fps, f"{width}:{height}", crf)
        if len(content) <= max_bytes:
            break
    else:
        raise ValueError(f"{path} is larger than {max_bytes} bytes at any quality: show fewer frames or a smaller width")
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(frames[poster]).resize((width, height)).save(path.with_suffix(".webp"), quality=70, method=6)
    path.write_bytes(content)


def show_video(path, alt, caption=""):
    """Show a video of `save` here. It plays when the reader starts it.

    Args:
      path: of the .mp4 file, its poster beside it.
      alt: what happens in it, in words, for those who don't see it.
      caption: a line under it.
    """
    show_videos((path, alt, caption))


def show_videos(*videos):
    """Show videos side by side, each given as (path, alt, caption), and a button that starts them together.

    They share the width, and stand below one another where the page is narrow.
    """
    from IPython.display import display

    texts = [f"Video{f' ({caption})' if caption else ''}: {alt}" for _, alt, caption in videos]
    display({"text/html": to_html(*videos), "text/plain": "\n".join(texts)}, raw=True)


def to_html(*videos) -> str:
    """The self-contained HTML of `show_videos`. Raises: FileNotFoundError for a video without its poster."""
    figures = "".join(_figure(Path(path), alt, caption) for path, alt, caption in videos)
    together = TOGETHER.replace("\n", " ") if len(videos) > 1 else ""
    return f'<div class="course-videos">{together}<div style="display:flex;flex-wrap:wrap;gap:1em">{figures}</div></div>'


def _figure(path: Path, alt: str, caption: str) -> str:
    from PIL import Image

    with Image.open(path.with_suffix(".webp")) as poster:
        width, height = poster.size
    label = html.escape(alt, quote=True)
    under = f'<figcaption style="color:inherit">{html.escape(caption)}</figcaption>' if caption else ""
    return (
        f'<figure style="margin:0;flex:1 1 {NARROWEST}px;max-width:{width}px">'
        f'<video controls muted playsinline preload="none" width="{width}" height="{height}" '
        f'style="width:100%;max-width:{width}px;height:auto" poster="{_uri(path.with_suffix(".webp"), "image/webp")}" '
        f'aria-label="{label}"><source src="{_uri(path, "video/mp4")}" type="video/mp4"></video>'
        f"{under}<p>{label}</p></figure>"
    )


def _uri(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _encoded(frames, fps, size, crf) -> bytes:
    """An MP4 file that browsers can play from its beginning; the same bytes for the same frames."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise RuntimeError("videos need an encoder: pip install imageio-ffmpeg") from None
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{frames.shape[2]}x{frames.shape[1]}", "-r", str(fps), "-i", "pipe:0"]
    coded = ["-c:v", "libx264", "-preset", "veryslow", "-crf", str(crf), "-pix_fmt", "yuv420p", "-threads", "1"]
    laid_out = ["-vf", f"scale={size}", "-movflags", "+faststart", "-fflags", "+bitexact", "-flags:v", "+bitexact"]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "video.mp4"
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *given, *coded, *laid_out, str(target)]
        done = subprocess.run(command, input=frames.tobytes(), capture_output=True)
        if done.returncode:
            raise RuntimeError(f"the encoder failed: {done.stderr.decode(errors='replace').strip()}")
        return target.read_bytes()
