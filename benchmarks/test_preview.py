"""The preview of the virtual rig in Chromium: from a frame to its drawn picture, and frames/s.

512² pixels with their live reconstruction, through the camera's protocol and the page's server.
"""

import shutil
import socket
import threading
import time

import jax
import numpy as np
import pytest

from helpers import ROOT
from thincam_jax.commands.checked_config import load_as
from thincam_jax.hardware.commands import command
from thincam_jax.hardware.commands.config import CaptureConfig
from thincam_jax.hardware.commands.run import build_study
from thincam_jax.hardware.preview import Preview
from thincam_jax.hardware.studies.images import live_image
from thincam_jax.plot.page import page_of

FRAMES, SKIPPED = 200, 20  # those before are compiled for

# The time at which each picture is decoded and painted, seconds since 1970.
DRAWN = """(count) => new Promise((done) => {
  const place = document.querySelector(".tc-explorer"), drawn = {};
  const picture = place.querySelector("img");
  new MutationObserver(async () => {
    const number = place.dataset.count;
    await picture.decode().catch(() => null);
    requestAnimationFrame(() => {
      drawn[number] = (performance.timeOrigin + performance.now()) / 1000;
      if (Number(number) >= count) done(drawn);
    });
  }).observe(place, { attributes: true, attributeFilter: ["data-count"] });
})"""


@pytest.mark.parametrize("with_image", [False, True])
def test_frames_are_drawn_as_they_come(with_image):
    uvicorn = pytest.importorskip("uvicorn", reason="uvicorn is not installed")
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with jax.enable_x64(False), socket.socket() as own:
        config = load_as(CaptureConfig, ROOT / "configs/rig_virtual.yaml")
        plan = command.build_plan(config)
        own.bind(("127.0.0.1", 0))
        own.listen()
        host = f"127.0.0.1:{own.getsockname()[1]}"
        with command.opened(config, plan) as rig:
            image = None
            if with_image:
                study = build_study(config, config.virtual.sensor)
                image = live_image(study, config.optics.object.width)
            procedure = config.acquisition.build(settle=config.display.settle)
            preview = Preview(rig, plan, procedure, image=image)
            grab, taken = rig.camera.trigger_and_grab, []

            def noted(timeout):
                frame = grab(timeout)
                taken.append(time.time())
                return frame

            rig.camera.trigger_and_grab = noted
            served = uvicorn.Config(page_of(preview, "rig", host, "t"), log_level="warning")
            server = uvicorn.Server(served)
            thread = threading.Thread(target=server.run, kwargs={"sockets": [own]})
            thread.start()
            try:
                with playwright.sync_playwright() as running:
                    browser = running.chromium.launch(
                        executable_path=chromium, args=["--no-sandbox"]
                    )
                    page = browser.new_page(viewport={"width": 1100, "height": 900})
                    page.set_default_timeout(300_000)
                    page.goto(f"http://{host}/?token=t")
                    page.locator(".tc-explorer[data-count]").wait_for()
                    drawn = page.evaluate(DRAWN, FRAMES)
                    browser.close()
            finally:
                server.should_exit = True
                thread.join()
    numbers = [int(number) for number in drawn if int(number) > SKIPPED]
    latency = 1000 * np.array([drawn[str(number)] - taken[number - 1] for number in numbers])
    rate = (len(numbers) - 1) / (drawn[str(numbers[-1])] - drawn[str(numbers[0])])
    middle, most = np.percentile(latency, (50, 95))
    print(f"\nreconstruction: {with_image}; {len(numbers)} pictures, {rate:.1f} frames/s")
    print(f"from a frame to its picture, ms: median {middle:.1f}, 95 % of them below {most:.1f}")
    assert (latency > 0).all()
