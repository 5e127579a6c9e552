"""See the extension as a user does: a real Blender window on a virtual screen, the zip installed, buttons pressed.

    python scripts/window/look.py --blender blender --out window_out
    python scripts/window/look.py --chroot DEBIAN_FOLDER --out window_out      # Blender of a distribution in a folder

Builds the zip, starts Xvfb (Debian's package xvfb) and Blender with software OpenGL, and runs `drive.py` in it, which
plays the scenes of `story.py` and asks for pictures of the whole screen, which ImageMagick's import takes. The exit
code is Blender's: not 0 when a scene went wrong. A chroot needs /proc, /dev, /tmp/.X11-unix and this checkout mounted
at their own paths.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
WANTED = "wanted"
"""File in which drive.py names the picture it waits for."""


def free_display() -> str:
    """A number no X server uses."""
    taken = {path.name.removeprefix("X") for path in Path("/tmp/.X11-unix").glob("X*")}
    return next(str(number) for number in range(90, 200) if str(number) not in taken)


def arguments() -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--blender", default="blender", help="the program, inside --chroot if that is given")
    parser.add_argument("--chroot", type=Path, help="folder of a system that has Blender (debootstrap)")
    parser.add_argument("--out", type=Path, default=ROOT / "window_out", help="folder for the pictures")
    parser.add_argument("--size", default="1600x1000", help="of the screen, pixels")
    parser.add_argument("--scenes", nargs="*", default=[], help="names of scenes to play; none: all")
    parser.add_argument("--python", type=Path, default=ROOT / ".venv/bin/python", help="interpreter of the backend")
    parser.add_argument("--time", type=float, default=1500.0, help="seconds after which Blender is ended")
    return parser.parse_args()


def photograph(blender: subprocess.Popen, scratch: Path, out: Path, display: str, time_s: float) -> int:
    """Take the pictures that `drive.py` asks for until Blender ends; its exit code.

    Blender's own screenshots are black with software OpenGL.
    """
    began = time.monotonic()
    while blender.poll() is None:
        if time.monotonic() - began > time_s:
            blender.kill()
            print(f"Blender was ended after {time_s:.0f} s", file=sys.stderr)
        wanted = scratch / WANTED
        if wanted.is_file() and (name := wanted.read_text()):
            subprocess.run(
                ["import", "-display", f":{display}", "-window", "root", str(out / f"{name}.png")], check=True
            )
            print(f"saved {name}.png", flush=True)
            wanted.unlink()
        time.sleep(0.05)
    return blender.returncode


def main() -> int:
    """Build, start, wait."""
    asked = arguments()
    asked.out.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=".window_", dir=ROOT / "build" if (ROOT / "build").is_dir() else ROOT))
    display = free_display()
    screen = subprocess.Popen(
        ["Xvfb", f":{display}", "-screen", "0", f"{asked.size}x24", "-ac"], stderr=subprocess.DEVNULL
    )
    try:
        subprocess.run([sys.executable, ROOT / "build_addon.py", "--out", scratch], check=True)
        archive = next(scratch.glob("*.zip"))
        environment = {
            **os.environ,
            "DISPLAY": f":{display}",
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "BLENDER_USER_RESOURCES": str(scratch / "user"),
        }
        command = [asked.blender, "--gpu-backend", "opengl", "--window-geometry", "0", "0", *asked.size.split("x")]
        command += ["--python-exit-code", "1", "--python", str(HERE / "drive.py"), "--"]
        command += [str(archive), str(scratch / WANTED), str(asked.python), *asked.scenes]
        if asked.chroot is not None:
            command = ["chroot", str(asked.chroot), *command]
        time.sleep(1.0)  # until the screen is there
        return photograph(subprocess.Popen(command, env=environment), scratch, asked.out, display, asked.time)
    finally:
        screen.terminate()
        shutil.rmtree(scratch, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
