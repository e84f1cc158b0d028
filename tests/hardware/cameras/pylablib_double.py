"""What `PylablibCamera` uses of pylablib's interface of cameras, as it is documented.

It stands in for `ICamera`, `IExposureCamera` and `IBinROICamera` where pylablib is not installed.
"""

import time
from types import SimpleNamespace


class Camera:
    class Error(RuntimeError):
        pass

    TimeoutError = Error
    FrameTransferError = type("FrameTransferError", (Error,), {})

    def __init__(self):
        self._acq_params, self._variables = None, {}
        self._frame_counter = SimpleNamespace(reset=lambda size=None: None)

    def _add_settings_variable(self, name, getter, setter):
        self._variables[name] = getter, setter

    def get_settings(self, include=0):
        return {name: get() for name, (get, _) in self._variables.items() if name in include}

    def apply_settings(self, settings):
        for name, value in settings.items():
            self._variables[name][1](value)

    def set_frame_format(self, fmt):
        assert fmt == "list"

    def set_frame_info_format(self, fmt):
        assert fmt == "namedtuple"

    def set_image_indexing(self, indexing):
        assert indexing == "rct"

    def setup_acquisition(self, **parameters):
        self._acq_params = parameters

    def clear_acquisition(self):
        self._acq_params = None

    def start_acquisition(self):
        if self._acq_params is None:
            self.setup_acquisition()

    def wait_for_frame(self, since="lastread", nframes=1, timeout=20.0, error_on_stopped=False):
        assert since == "start" and error_on_stopped
        deadline = time.monotonic() + timeout
        while self._get_acquired_frames() < nframes:
            if time.monotonic() > deadline:
                raise self.TimeoutError
            time.sleep(1e-3)
        return True

    def read_multiple_images(self, rng=None, return_info=False):
        assert return_info
        last = min(rng[1], self._get_acquired_frames())
        return self._read_frames((rng[0], last), return_info=True)

    def get_exposure(self):
        return self.get_frame_timings()[0]
