"""A full-screen window on a monitor, or a light modulator driven as one, by SDL2."""

import ctypes
import warnings
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from thincam_jax.hardware.base import Connected, Disconnected, Identity, NotFound, ProtocolError
from thincam_jax.hardware.displays.levels import GreyLevelDisplay, GreyLevels

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # it reports which SDL libraries it has found
    import sdl2

_GREY = np.uint32(0x010101)  # red, green and blue alike
_NOT_SHOWN = sdl2.SDL_WINDOW_HIDDEN | sdl2.SDL_WINDOW_MINIMIZED


class SdlDisplay(GreyLevelDisplay):
    """A borderless window without a cursor, pixel by pixel.

    `show` returns after the monitor's next refresh if the driver supports `vsync`. Only the thread
    that opened it may use it. The monitor must not scale: its mode has to be the panel's.
    """

    @dataclass(frozen=True)
    class Options:
        """`monitor`: its name or number, "" if there is only one.

        `size` is (rows, columns) of a window in the monitor's upper left corner, None for the full
        screen; `grey_levels` a file with the table of grey levels.
        """

        monitor: str = ""
        size: tuple[int, int] | None = None
        grey_levels: str = ""

    def __init__(self, options: Options):
        super().__init__(GreyLevels.load(options.grey_levels) if options.grey_levels else None)
        self._window: Any = None
        for hint, value in (
            (sdl2.SDL_HINT_NO_SIGNAL_HANDLERS, b"1"),  # Ctrl-C stays with Python
            (sdl2.SDL_HINT_VIDEO_MINIMIZE_ON_FOCUS_LOSS, b"0"),
            (sdl2.SDL_HINT_RENDER_SCALE_QUALITY, b"nearest"),
        ):
            sdl2.SDL_SetHint(hint, value)
        if sdl2.SDL_InitSubSystem(sdl2.SDL_INIT_VIDEO) != 0:
            raise NotFound("SDL", "open", _error(), "connect a monitor and set DISPLAY")
        self._holds_sdl = True
        try:
            self._open(options)
        except BaseException:
            self.close()
            raise

    @classmethod
    def connected(cls) -> list[Connected]:
        if sdl2.SDL_InitSubSystem(sdl2.SDL_INIT_VIDEO) != 0:
            return []  # no monitor, or none that this session may use
        found, bounds, dots = [], sdl2.SDL_Rect(), ctypes.c_float()
        try:
            for number, name in enumerate(_names()):
                sdl2.SDL_GetDisplayBounds(number, ctypes.byref(bounds))
                known = sdl2.SDL_GetDisplayDPI(number, None, ctypes.byref(dots), None) == 0
                pitch = f" of {25.4 / dots.value:.4g} mm" if known and dots.value > 0 else ""
                about = f"{bounds.h} × {bounds.w} pixels{pitch}, at x {bounds.x}, y {bounds.y}"
                found.append(Connected("display", "sdl", {"monitor": name or number}, about))
        finally:
            sdl2.SDL_QuitSubSystem(sdl2.SDL_INIT_VIDEO)
        return found

    def _open(self, options: Options) -> None:
        names = _names()
        number = _chosen(options.monitor, names)
        bounds = sdl2.SDL_Rect()
        sdl2.SDL_GetDisplayBounds(number, ctypes.byref(bounds))
        rows, columns = options.size or (bounds.h, bounds.w)
        driver = sdl2.SDL_GetCurrentVideoDriver().decode()
        self.identity = Identity("SDL", names[number], f"monitor {number}", driver)
        flags = sdl2.SDL_WINDOW_BORDERLESS | sdl2.SDL_WINDOW_ALLOW_HIGHDPI
        if options.size is None:
            flags |= sdl2.SDL_WINDOW_FULLSCREEN_DESKTOP
        self._window = sdl2.SDL_CreateWindow(
            b"thincam", bounds.x, bounds.y, columns, rows, sdl2.SDL_WINDOW_SHOWN | flags
        )
        self._renderer = self._window and sdl2.SDL_CreateRenderer(
            self._window, -1, sdl2.SDL_RENDERER_PRESENTVSYNC
        )
        if not self._renderer:
            raise ProtocolError(str(self.identity), "open", _error(), "try the tkinter display")
        sdl2.SDL_ShowCursor(sdl2.SDL_DISABLE)
        sdl2.SDL_DisableScreenSaver()
        info = sdl2.SDL_RendererInfo()
        sdl2.SDL_GetRendererInfo(self._renderer, ctypes.byref(info))
        self.vsync = bool(info.flags & sdl2.SDL_RENDERER_PRESENTVSYNC)
        self.shape = self._output()
        self._texture = sdl2.SDL_CreateTexture(
            self._renderer,
            sdl2.SDL_PIXELFORMAT_RGB888,
            sdl2.SDL_TEXTUREACCESS_STREAMING,
            self.shape[1],
            self.shape[0],
        )
        self._pixels = np.empty(self.shape, np.uint32)
        self._present(np.zeros(self.shape, np.uint8))

    def close(self) -> None:
        if self._window:
            sdl2.SDL_DestroyWindow(self._window)  # with its renderer and texture
            self._window = None
        if self._holds_sdl:
            sdl2.SDL_QuitSubSystem(sdl2.SDL_INIT_VIDEO)
            self._holds_sdl = False

    def _present(self, levels: np.ndarray) -> None:
        self._require_window()
        np.multiply(levels, _GREY, out=self._pixels)
        data, pitch = self._pixels.ctypes.data_as(ctypes.c_void_p), self._pixels.strides[0]
        failed = sdl2.SDL_UpdateTexture(self._texture, None, data, pitch)
        # With vsync, the first may be queued until the second is accepted.
        for _ in range(2 if self.vsync else 1):
            failed = failed or sdl2.SDL_RenderCopy(self._renderer, self._texture, None, None)
            sdl2.SDL_RenderPresent(self._renderer)
        if failed:
            remedy = "open the display again"
            raise ProtocolError(str(self.identity), "show", _error(), remedy)
        self._require_window()

    def _require_window(self) -> None:
        """Raise Disconnected where the window was closed or the monitor's size has changed."""
        cause, event = "" if self._window else "the window is closed", sdl2.SDL_Event()
        while self._window and sdl2.SDL_PollEvent(ctypes.byref(event)):
            closed = event.window.event == sdl2.SDL_WINDOWEVENT_CLOSE
            if event.type == sdl2.SDL_WINDOWEVENT and closed:
                cause = "the window was closed"
        if not cause and sdl2.SDL_GetWindowFlags(self._window) & _NOT_SHOWN:
            cause = "the window is hidden"
        if not cause and self._output() != self.shape:
            cause = "the monitor has another size now"
        if cause:
            remedy = "connect the monitor and open the display again"
            raise Disconnected(str(self.identity), "show", cause, remedy)

    def _output(self) -> tuple[int, int]:
        columns, rows = ctypes.c_int(), ctypes.c_int()
        sdl2.SDL_GetRendererOutputSize(self._renderer, ctypes.byref(columns), ctypes.byref(rows))
        return rows.value, columns.value


def _names() -> list[str]:
    """Names of the monitors, by their numbers."""
    count = sdl2.SDL_GetNumVideoDisplays()
    return [(sdl2.SDL_GetDisplayName(k) or b"").decode(errors="replace") for k in range(count)]


def _chosen(wanted: str, names: list[str]) -> int:
    matching = [k for k, name in enumerate(names) if wanted in ("", name)]
    if wanted not in names:
        with suppress(ValueError):
            matching = [k for k in range(len(names)) if k == int(wanted)]
    if len(matching) == 1:
        return matching[0]
    listed = ", ".join(f"{k} {name!r}" for k, name in enumerate(names)) or "none"
    cause = f"no monitor {wanted!r}" if wanted else f"{len(names)} monitors"
    if len(matching) > 1 and wanted:
        cause = f"{len(matching)} monitors are called {wanted!r}"
    raise NotFound("SDL", "open", cause, f"give monitor by name or number; found: {listed}")


def _error() -> str:
    return sdl2.SDL_GetError().decode(errors="replace") or "SDL does not say why"
