"""Test the extension in a real Blender window on a virtual screen: install the zip, press buttons, take screenshots.

    python scripts/window/look.py --blender blender --out window_out
    python scripts/window/look.py --chroot DEBIAN_FOLDER --out window_out      # Blender of a distribution in a folder

Builds the zip, starts Xvfb (Debian's package xvfb) and Blender with software OpenGL, and runs `drive.py` in it, which
plays the scenes of `scenes.py` and requests screenshots of the whole screen (taken by ImageMagick's import) and clicks
(made by xdotool). Next to each NAME.png, NAME.json gives the position of the sidebar. The exit code is Blender's, which
is not 0 if a scene failed. A chroot needs /proc, /dev, /tmp/.X11-unix, this checkout and the interpreter's environment
mounted at their own paths; Debian's packages are blender, python3-openvdb, python3-openimageio, python3-cattr,
python3-numpy, python3-requests, libgl1 and libgl1-mesa-dri.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
REQUEST = "request"
"""File in which drive.py requests a screenshot, a click or a key."""
FIGURES = "figures.json"
"""What scenes have measured, beside the pictures; for `benchmarks/first_sight.py --window`."""
VISIBLY = "2%"
"""Of the range of values: smaller differences come from dithering."""
_QUIET = "import bpy; bpy.context.preferences.view.show_splash = False; bpy.ops.wm.save_userpref()"
"""At its first start, Blender would show the splash screen with its quick set-up over everything."""


def free_display() -> str:
    """A display number that no X server uses."""
    taken = {path.name.removeprefix("X") for path in Path("/tmp/.X11-unix").glob("X*")}
    return next(str(number) for number in range(90, 200) if str(number) not in taken)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--blender", default="blender", help="the program, inside --chroot if that is given")
    parser.add_argument("--chroot", type=Path, help="folder of a system that has Blender (debootstrap)")
    parser.add_argument("--out", type=Path, default=ROOT / "window_out", help="folder for the pictures")
    parser.add_argument("--size", default="1600x1400", help="size of the screen in pixels")
    parser.add_argument(
        "--scenes", nargs="*", default=[], help="names of scenes to play; none: all; viewer, by itself: the viewer"
    )
    parser.add_argument("--python", type=Path, default=ROOT / ".venv/bin/python", help="interpreter of the backend")
    parser.add_argument("--time", type=float, default=3000.0, help="seconds after which Blender is ended")
    return parser.parse_args()


def serve(blender: subprocess.Popen, scratch: Path, out: Path, display: str, time_s: float) -> int:
    """Serve the requests of `drive.py` until Blender ends; returns its exit code."""
    began = time.monotonic()
    request = scratch / REQUEST
    while blender.poll() is None:
        if time.monotonic() - began > time_s:
            blender.kill()
            print(f"Blender was ended after {time_s:.0f} s", file=sys.stderr)
        if request.is_file():
            answer = do(json.loads(request.read_text(encoding="utf-8")), out, display)
            if answer is not None:
                request.with_suffix(".answer").write_text(json.dumps(answer), encoding="utf-8")
            request.unlink()
        time.sleep(0.05)
    return blender.returncode


def do(request: dict, out: Path, display: str) -> list[int] | None:
    """Take a screenshot, note figures, click, press a key, or compare screenshots; returns an answer, if any.

    Blender's own screenshots are black with software OpenGL.
    """
    hand = ["xdotool"]
    environment = {**os.environ, "DISPLAY": f":{display}"}
    if "picture" in request:
        path = out / f"{request['picture']}.png"
        little = ["-define", "png:compression-level=1"]  # 9 takes seconds of a busy processor
        subprocess.run(["import", "-display", f":{display}", "-window", "root", *little, str(path)], check=True)
        path.with_suffix(".json").write_text(json.dumps(request["where"]), encoding="utf-8")
        print(f"saved {path.name}", flush=True)
    if "figures" in request:
        note(request["figures"], out)
    if "point" in request:
        x, y = map(str, request["point"])
        subprocess.run([*hand, "mousemove", x, y], check=True, env=environment)
    if request.get("click"):
        time.sleep(0.3)
        subprocess.run([*hand, "click", "1"], check=True, env=environment)
    if "key" in request:
        times = ["--delay", "2", "--repeat", str(request.get("times", 1)), "--repeat-delay", "2"]
        subprocess.run([*hand, "key", *times, request["key"]], check=True, env=environment)
    if "pixels that differ" in request:
        one, other = (out / f"{name}.png" for name in request["pixels that differ"])
        return [differing(one, other, *box) for box in request["boxes"]]
    return None


def note(figures: dict, out: Path) -> None:
    """Add to the file of figures."""
    path = out / FIGURES
    before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    path.write_text(json.dumps({**before, **figures}, indent=2) + "\n", encoding="utf-8")
    print(figures, flush=True)


def differing(one: Path, other: Path, left: int, top: int, right: int, bottom: int) -> int:
    """How many pixels of a box differ visibly between two pictures."""
    box = f"[{right - left}x{bottom - top}+{left}+{top}]"
    command = ["compare", "-metric", "AE", "-fuzz", VISIBLY, f"{one}{box}", f"{other}{box}", "null:"]
    # exits with 1 where pictures differ
    found = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    if found.returncode > 1:
        raise RuntimeError(found.stderr)
    return int(float(found.stderr.split()[0]))


def main() -> int:
    options = arguments()
    options.out.mkdir(parents=True, exist_ok=True)
    display = free_display()
    scratch = ROOT / "build" / f"window_{display}"  # the same in each run, for numba to find its kernels again
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    screen = subprocess.Popen(
        ["Xvfb", f":{display}", "-screen", "0", f"{options.size}x24", "-ac"], stderr=subprocess.DEVNULL
    )
    try:
        which = ["--viewer"] if options.scenes == ["viewer"] else []
        subprocess.run([sys.executable, ROOT / "build_addon.py", *which, "--out", scratch], check=True)
        archive = next(scratch.glob("*.zip"))
        environment = {
            **os.environ,
            "DISPLAY": f":{display}",
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "BLENDER_USER_RESOURCES": str(scratch / "user"),
            "PRIMDIFFUSION_CACHE": str(ROOT / "build" / "window_cache"),
        }
        environment.pop("PRIMDIFFUSION_PYTHON", None)
        program = [] if options.chroot is None else ["chroot", str(options.chroot)]
        program.append(options.blender)
        subprocess.run([*program, "-b", "--python-expr", _QUIET], env=environment, check=True, capture_output=True)
        command = [*program, "--gpu-backend", "opengl", "--window-geometry", "0", "0", *options.size.split("x")]
        command += ["--python-exit-code", "1", "--python", str(HERE / "drive.py"), "--"]
        command += [str(archive), str(scratch / REQUEST), str(options.python), *options.scenes]
        code = serve(subprocess.Popen(command, env=environment), scratch, options.out, display, options.time)
        note({"window_crashes": int(code < 0 and code != -signal.SIGKILL)}, options.out)
        return code
    finally:
        screen.terminate()
        shutil.rmtree(scratch, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
