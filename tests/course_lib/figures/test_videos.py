"""Videos are small, lie in the page itself, play when asked, and say in words what they show."""

import re

import gymnasium as gym
import IPython.display
import numpy as np
import pytest
from PIL import Image

from course_lib.figures import videos


@pytest.fixture(scope="module")
def lander(tmp_path_factory):
    """A video of a lander without engines."""
    env = gym.make("LunarLanderContinuous-v3", render_mode="rgb_array")
    frames, total = videos.film(lambda obs: np.zeros(2, np.float32), env, seed=3)
    assert total < 0 and frames.shape[1:] == (400, 600, 3) and frames.dtype == np.uint8
    path = tmp_path_factory.mktemp("videos") / "lander.mp4"
    videos.save(frames, path)
    return path, frames


def test_frames_are_thinned_and_the_seed_decides_them(lander):
    class Dot:
        render_mode, metadata = "rgb_array", {"render_fps": 50}

        def reset(self, seed):
            self.steps = 0
            return np.zeros(1), {}

        def step(self, action):
            self.steps += 1
            return np.zeros(1), 1.0, self.steps == 7, False, {}

        def render(self):
            return np.full((2, 2, 3), self.steps, np.uint8)

    frames, total = videos.film(lambda obs: 0, Dot())
    assert frames[:, 0, 0, 0].tolist() == [0, 2, 4, 6, 7] and total == 7.0
    assert videos.film(lambda obs: 0, Dot(), max_steps=4)[0][:, 0, 0, 0].tolist() == [0, 2, 4]
    Dot.render_mode = "human"
    with pytest.raises(ValueError, match=r"rgb_array.*got 'human'"):
        videos.film(lambda obs: 0, Dot())


def test_a_video_is_small_and_the_same_each_time(lander, tmp_path):
    path, frames = lander
    assert path.stat().st_size < 250_000 * len(frames) / 200  # 250 kB for 8 seconds
    videos.save(frames, tmp_path / "again.mp4")
    assert (tmp_path / "again.mp4").read_bytes() == path.read_bytes()
    with Image.open(path.with_suffix(".webp")) as poster:
        assert poster.size == (400, 266)


def test_quality_falls_until_the_video_fits(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(10, 40, 60, 3), dtype=np.uint8)
    videos.save(noise, tmp_path / "good.mp4", width=60)
    good = (tmp_path / "good.mp4").stat().st_size
    videos.save(noise, tmp_path / "poor.mp4", width=60, max_bytes=good // 2)
    assert (tmp_path / "poor.mp4").stat().st_size <= good // 2
    with pytest.raises(ValueError, match="larger than 10 bytes at any quality"):
        videos.save(noise, tmp_path / "none.mp4", width=60, max_bytes=10)
    with pytest.raises(ValueError, match=r"frames must be .* got \(4, 4, 3\)"):
        videos.save(noise[0, :4, :4], tmp_path / "none.mp4")
    assert not (tmp_path / "none.mp4").exists()


def test_the_page_gets_words_and_nothing_from_elsewhere(lander, monkeypatch):
    path, _ = lander
    page = videos.to_html((path, 'It falls & "crashes".', "first"), (path, "It lands.", "last"))
    assert page.count("<video ") == 2 and "autoplay" not in page and page.count('preload="none"') == 2
    assert page.count("It falls &amp; &quot;crashes&quot;.") == 2, "as label and under the video"
    assert '<figcaption style="color:inherit">first</figcaption>' in page
    assert not re.search(r"#[0-9a-f]{3}\b", page), "colours of its own, which one of the themes would not suit"
    assert all(source.startswith("data:") for source in re.findall(r'(?:src|poster)="([^"]+)"', page))
    shown = []
    monkeypatch.setattr(IPython.display, "display", lambda data, raw: shown.append(data))
    videos.show_video(path, "It falls.", "first")
    assert shown[0]["text/plain"] == "Video (first): It falls." and "<video" in shown[0]["text/html"]


def test_a_browser_plays_it_from_a_file_when_asked(browser, lander, tmp_path):
    path, frames = lander
    words = "The lander falls and crashes."
    head = "<!doctype html><html lang=en><meta charset=utf-8><title>t</title><body>"
    (tmp_path / "page.html").write_text(head + videos.to_html((path, words, "first"), (path, words, "again")))
    with browser.new_context(offline=True, viewport={"width": 1000, "height": 700}) as context:
        page = context.new_page()
        page.goto((tmp_path / "page.html").as_uri())
        video = page.get_by_label(words).first
        assert video.evaluate("v => v.paused && v.currentTime === 0 && v.readyState === 0"), "nothing plays or loads by itself"
        box = video.bounding_box()
        assert (round(box["width"]), round(box["height"])) == (400, 266)
        assert video.bounding_box()["y"] == page.get_by_label(words).last.bounding_box()["y"], "side by side"
        video.evaluate("v => v.play()")
        page.wait_for_function("document.querySelector('video').currentTime > 0.2", timeout=20_000)
        state = video.evaluate("v => [v.readyState, v.videoWidth, v.videoHeight, v.duration, v.error]")
        assert state[0] >= 2 and state[1:3] == [400, 266] and state[4] is None
        assert state[3] == pytest.approx(len(frames) / 25, abs=0.1)
        page.set_viewport_size({"width": 360, "height": 700})
        assert video.bounding_box()["width"] <= 360


def test_videos_side_by_side_start_together_with_one_button(browser, lander, tmp_path):
    path, _ = lander
    head = "<!doctype html><html lang=en><meta charset=utf-8><title>t</title><body>"
    three = [(path, f"The lander falls, {time} time.", time) for time in ("first", "second", "third")]
    (tmp_path / "page.html").write_text(head + videos.to_html(*three) + videos.to_html((path, "Alone.", "")))
    with browser.new_context(offline=True, viewport={"width": 720, "height": 700}) as context:
        page = context.new_page()
        page.goto((tmp_path / "page.html").as_uri())
        assert len({one.bounding_box()["y"] for one in page.locator("video").all()[:3]}) == 1, "they share the width of a page"
        page.evaluate("document.querySelectorAll('video')[1].currentTime = 3")
        page.get_by_role("button").focus()  # one alone has its own control, and no button
        page.keyboard.press("Enter")
        page.wait_for_function("[...document.querySelectorAll('video')].slice(0, 3).every((one) => one.currentTime > 0.2)")
        times = page.evaluate("[...document.querySelectorAll('video')].map((one) => one.currentTime)")
        assert max(times[:3]) - min(times[:3]) < 0.5 and times[3] == 0
        page.set_viewport_size({"width": 390, "height": 700})
        boxes = [one.bounding_box() for one in page.locator("video").all()[:3]]
        assert boxes[0]["y"] < boxes[1]["y"] < boxes[2]["y"] and boxes[0]["width"] <= 390, "stacked on a phone"
