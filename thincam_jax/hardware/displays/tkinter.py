"""A window on a monitor by tkinter, which comes with Python, if SDL is not available."""

import tkinter
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from thincam_jax.hardware.base import Disconnected, Identity, NotFound
from thincam_jax.hardware.displays.levels import GreyLevelDisplay, GreyLevels


class TkinterDisplay(GreyLevelDisplay):
    """A borderless window. It waits for the window system, not for the monitor's next refresh.

    Only the thread that opened it may use it.
    """

    @dataclass(frozen=True)
    class Options:
        """`left`, `top`: place of the window on the desktop, in pixels; tkinter knows no monitors.

        `size` is (rows, columns), None for all of the first monitor; `grey_levels` a table's file.
        """

        left: int = 0
        top: int = 0
        size: tuple[int, int] | None = None
        grey_levels: str = ""

    def __init__(self, options: Options):
        super().__init__(GreyLevels.load(options.grey_levels) if options.grey_levels else None)
        try:
            self._root = tkinter.Tk()
        except tkinter.TclError as error:
            remedy = "connect a monitor and set DISPLAY"
            raise NotFound("tkinter", "open", str(error), remedy) from error
        version = str(self._root.tk.call("info", "patchlevel"))
        self.identity = Identity("tkinter", "window", "", version)
        screen = self._root.winfo_screenheight(), self._root.winfo_screenwidth()
        rows, columns = options.size or screen
        self.shape = rows, columns
        self._root.overrideredirect(True)
        self._root.geometry(f"{columns}x{rows}+{options.left}+{options.top}")
        self._root.configure(cursor="none")
        self._image = tkinter.PhotoImage(master=self._root, width=columns, height=rows)
        label = tkinter.Label(self._root, image=self._image, borderwidth=0, highlightthickness=0)
        label.place(x=0, y=0, width=columns, height=rows)
        self._present(np.zeros(self.shape, np.uint8))

    def close(self) -> None:
        with suppress(tkinter.TclError):
            self._root.destroy()

    def _present(self, levels: np.ndarray) -> None:
        try:
            header = f"P5 {levels.shape[1]} {levels.shape[0]} 255\n".encode()
            self._image.configure(data=header + levels.tobytes(), format="ppm")
            self._root.lift()
            self._root.update()
            # The window system answers in order, so that it has drawn once it answers.
            self._root.winfo_pointerxy()
        except tkinter.TclError as error:
            remedy = "open the display again"
            raise Disconnected("tkinter window", "show", str(error), remedy) from error
