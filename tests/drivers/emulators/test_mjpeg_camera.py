"""The emulated MJPEG camera, as a plain HTTP client and OpenCV's own reader see it."""

import http.client
import threading
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from drivers.emulators.mjpeg_camera import BOUNDARY, MjpegCamera
from tests.drivers.real.cameras import counting, number_of


def connected(camera):
    url = urlsplit(camera.address)
    client = http.client.HTTPConnection(str(url.hostname), url.port, timeout=5)
    client.request("GET", url.path)
    return client, client.getresponse()


def part(response):
    """Headers and body of the next part, read as RFC 2046 has them."""
    while response.readline().strip() != f"--{BOUNDARY}".encode():
        pass
    headers = http.client.parse_headers(response)
    return headers, response.read(int(headers["Content-Length"]))


def test_parts_say_their_length_and_when_they_were_taken():
    with MjpegCamera(counting(), 60) as camera:
        before = time.time()
        client, response = connected(camera)
        assert response.headers.get_content_type() == "multipart/x-mixed-replace"
        assert response.headers.get_boundary() == BOUNDARY
        times = []
        for n in range(1, 4):
            headers, body = part(response)
            assert headers["Content-Type"] == "image/jpeg"
            image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None and number_of(np.asarray(image, np.uint8)) >= n
            times.append(float(headers["X-Timestamp"]))
        assert before - 0.001 < times[0] < times[1] < times[2] < time.time()
        client.close()


def test_opencvs_own_reader_reads_it():
    with MjpegCamera(counting(), 60) as camera:
        capture = cv2.VideoCapture(camera.address, cv2.CAP_FFMPEG)
        numbers = [number_of(np.asarray(capture.read()[1], np.uint8)) for _ in range(5)]
        capture.release()
    assert numbers == sorted(set(numbers)) and numbers[0] > 0


def test_nothing_is_rendered_while_nobody_looks():
    asked = threading.Event()

    def picture():
        asked.set()
        return np.zeros((48, 64, 3), np.uint8)

    with MjpegCamera(picture, 60) as camera:
        assert not asked.wait(0.2)
        client, response = connected(camera)
        part(response)
        client.close()
        response.close()
        for _ in range(3):  # it notices within a picture or two that they have gone
            asked.clear()
            if not asked.wait(0.2):
                break
        assert not asked.wait(0.2) and camera.clients == 0


def test_several_clients_see_the_same_pictures_rendered_once():
    with MjpegCamera(counting(), 60) as camera:
        clients = [connected(camera) for _ in range(3)]
        seen = []
        for _, response in clients:
            numbers = []
            for _ in range(20):
                image = cv2.imdecode(np.frombuffer(part(response)[1], np.uint8), cv2.IMREAD_COLOR)
                numbers.append(number_of(np.asarray(image, np.uint8)))
            seen.append(numbers)
        assert camera.count >= max(map(max, seen))
        for client, response in clients:
            response.close()
            client.close()
    assert all(numbers == sorted(set(numbers)) for numbers in seen)
    assert set(seen[0]) & set(seen[1]) & set(seen[2])


def test_a_client_that_takes_nothing_holds_up_no_other():
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    with MjpegCamera(lambda: noise, 60, quality=100) as camera:
        lazy = connected(camera)
        client, response = connected(camera)
        for _ in range(60):  # far more than the network holds
            part(response)
        for end in (response, client, *lazy):
            end.close()


def test_its_port_can_be_told_and_is_the_same_after_it_was_off():
    camera = MjpegCamera(counting())
    with camera:
        first = camera.address
    with camera:
        assert camera.address == first
        with pytest.raises(OSError):
            MjpegCamera(counting(), port=int(first.rpartition(":")[2].partition("/")[0])).open()


def test_closing_twice_is_harmless_and_leaves_no_thread():
    camera = MjpegCamera(counting())
    camera.open()
    client, response = connected(camera)
    part(response)
    camera.close()
    camera.close()
    assert response.read() is not None  # it ends
    response.close()
    client.close()
    assert not [t for t in threading.enumerate() if "mjpeg" in t.name]
