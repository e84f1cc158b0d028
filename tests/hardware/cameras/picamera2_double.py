"""What `RaspberryPiCamera` uses of picamera2's interface, as it is documented (0.3.31).

A sensor that runs freely: controls take effect as it starts, or some frames later; exposures are
whole lines, rows are padded, and a frame that nobody fetched waits.
"""

import time

import numpy as np

LINE = 18.9  # µs
SENSOR = 10, 13  # rows, columns
DELAY = 3  # frames until controls take effect
BLACK = 4096  # of 16 bits


class Request:
    def __init__(self, camera, facts, rows):
        self._camera, self._facts, self._rows = camera, facts, rows

    def get_metadata(self):
        return dict(self._facts)

    def make_array(self, name):
        assert name == "raw"
        return self._rows

    def release(self):
        self._camera.held -= 1


class Picamera2:
    connected = [
        {"Model": "imx219", "Location": 2, "Rotation": 180, "Id": "/base/imx219@10", "Num": 0}
    ]
    model_5 = False  # a Raspberry Pi 5: words of 16 bit, left-aligned, or compressed
    order, busy, faults = "SRGGB", False, set()
    seen = None  # function of a frame's number: its counts of 12 bit
    opened: list["Picamera2"] = []

    @classmethod
    def global_camera_info(cls):
        return [dict(one) for one in cls.connected]

    def __init__(self, camera_num=0):
        if self.busy:
            raise RuntimeError("Failed to acquire camera: Device or resource busy")
        self.camera_properties = {
            "Model": self.connected[camera_num]["Model"], "PixelArraySize": SENSOR[::-1]
        }  # fmt: skip
        self.camera_controls = {
            "ExposureTime": (75, 11_766_829, None), "AnalogueGain": (1.0, 10.7, None)
        }  # fmt: skip
        self.running, self.held, self.count, self.controls = False, 0, 0, []
        self.asked, self.waiting, self.cancelled, self.at = [], None, 0, (20_000, 1.0)
        type(self).opened.append(self)

    def create_still_configuration(self, raw, buffer_count=1):
        assert raw["size"] == SENSOR[::-1] and not raw["format"].endswith("_")
        return {"raw": dict(raw), "buffer_count": buffer_count}

    def configure(self, config):
        assert not self.running
        name = config["raw"]["format"]
        name = name if name.startswith("R") else self.order + name[5:]
        if self.model_5:
            bare = name.partition("_")[0]
            name = bare[1:5] + "_PISP_COMP1" if "_" in name else bare.rstrip("0123456789") + "16"
        self.raw = {"format": name, "size": config["raw"]["size"], "stride": 0}
        self.bits = int(
            "".join(c for c in config["raw"]["format"].partition("_")[0] if c.isdigit())
        )

    def camera_configuration(self):
        return {"raw": self.raw}

    def start(self):
        assert not self.running
        self.running, self.waiting = True, None
        if "stuck" not in self.faults:
            self.apply(self.controls[-1][1])
        self.controls = []
        if "old" in self.faults:
            self.controls, self.at = [(self.count + 2, self.asked[-1])], (5000, 1.0)

    def apply(self, controls):
        lines = int(controls["ExposureTime"] / LINE)
        self.at = int(lines * LINE), 256 / round(256 / controls["AnalogueGain"])

    def stop(self):
        self.running = False

    def close(self):
        self.running = False

    def cancel_all_and_flush(self):
        self.cancelled += 1

    def set_controls(self, controls):
        assert controls["AeEnable"] is controls["AwbEnable"] is False
        self.asked.append(controls)
        self.controls.append((self.count + DELAY, controls))

    def capture_request(self, wait):
        assert self.running and 0 < wait < 20
        if "unplug" in self.faults:
            raise RuntimeError("Camera frontend has timed out!")
        if "nothing" in self.faults:
            raise TimeoutError
        frame, self.waiting = self.waiting or self._frame(), None
        if "queued" in self.faults:
            self.waiting = self._frame()
        self.held += 1
        return frame

    def _frame(self):
        self.count += 1
        for when, controls in self.controls:
            if when == self.count:
                self.apply(controls)
        self.controls = [one for one in self.controls if one[0] > self.count]
        exposure, gain = self.at
        time.sleep(1e-6 * exposure)
        facts = {
            "ExposureTime": exposure, "AnalogueGain": gain, "DigitalGain": 1.0,
            "SensorTimestamp": time.monotonic_ns() + 1000, "SensorBlackLevels": (BLACK,) * 4
        }  # fmt: skip
        return Request(self, facts, rows_of(self.seen(self.count), self.raw["format"], self.bits))


def rows_of(counts, name, bits):
    """Rows of bytes of counts of 12 bit, in a format of libcamera, padded to 32 bytes."""
    counts = (counts >> (12 - bits)).astype(np.uint16)
    if name.endswith("_CSI2P"):
        group = 4 if bits == 10 else 2
        padded = np.pad(counts, ((0, 0), (0, -counts.shape[1] % group)))
        parts = padded.reshape(len(counts), -1, group)
        low = parts & (2 ** (bits - 8) - 1)
        last = sum(low[..., k] << ((bits - 8) * k) for k in range(group))[..., None]
        packed = np.concatenate([parts >> (bits - 8), last], axis=-1).astype(np.uint8)
        rows = packed.reshape(len(counts), -1)
    elif bits == 8:
        rows = counts.astype(np.uint8)
    else:
        words = counts << (16 - bits) if name.endswith("16") else counts
        rows = words.astype("<u2").view(np.uint8).reshape(len(counts), -1)
    return np.pad(rows, ((0, 0), (0, -rows.shape[1] % 32)))
