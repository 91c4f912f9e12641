"""A run in the web viewer, in a browser: it draws, it is quiet, and no request leaves this machine."""

import re
import signal
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from experiments.ports import free_port
from tests.experiments.chromium import launched

SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PATIENCE = 200_000  # [ms]: 43 MB of WebAssembly are compiled, and everything is drawn by the processor


@pytest.fixture(scope="module")
def browser():
    with launched(*SOFTWARE) as browser:
        yield browser


@pytest.fixture(scope="module")
def empty_run(shared_command):
    """A run that was cut off before it began: the smallest that there is to show."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from experiments.files import dump_resolved, load

    folder = shared_command.folder / "cut_off"
    folder.mkdir()
    (folder / "experiment.yaml").write_text(dump_resolved(load("grasped_static")))
    return folder


@pytest.mark.timeout(300)
def test_the_page_draws_is_quiet_asks_nobody_else_and_ends_on_ctrl_c(browser, empty_run, shared_command):
    port = free_port()
    process = shared_command.start("view", str(empty_run), "--web", "--no-browser", "--port", str(port))
    assert process.stderr is not None
    told = iter(process.stderr.readline, "")
    url = next(found[0] for line in told if (found := re.search(r"http://\S+", line)))
    assert url == f"http://127.0.0.1:{port}/"

    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(PATIENCE)
    page = context.new_page()
    asked, errors = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: message.type == "error" and errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    with page.expect_request(re.compile("/ReadMessages$"), timeout=PATIENCE):  # it runs, and asks for the run
        page.goto(url)
    page.wait_for_selector("canvas.visible")
    # two frames later it has drawn, and has reported itself, if it ever does
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    picture = cv2.imdecode(np.frombuffer(page.screenshot(timeout=PATIENCE), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and len(np.unique(picture.reshape(-1, 3), axis=0)) > 50  # panels, names, a font
    # what is meant for elsewhere is answered here
    assert page.evaluate("fetch('https://tel.rerun.io/api/pog', { method: 'POST' }).then((r) => r.status)") == 204
    hosts = {urlsplit(each).hostname for each in asked if not each.startswith(("data:", "blob:"))}
    assert hosts == {"127.0.0.1"}
    assert errors == []
    # and were it asked all the same, the policy would refuse
    refused = "new Promise((r) => { addEventListener('securitypolicyviolation', (e) => r(e.blockedURI)); %s })"
    elsewhere = "new Image().src = 'https://example.org/a.png'"
    assert page.evaluate(refused % elsewhere) == "https://example.org/a.png"
    context.close()

    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 0
