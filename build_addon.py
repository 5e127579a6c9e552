"""Build the extension as one zip: the add-on, the backend, the default checkpoints and the manual.

    python build_addon.py [--out dist] [--index]
    python build_addon.py --viewer [--gallery DIR] [--out dist]

The viewer is a second extension of the same sources, for repositories that reject extensions which download code: it
opens, poses, animates, reshapes, draws and exports humans, and generates with a backend that the user has installed. It
has no set-up, no backend and no checkpoints, and may bring a gallery of .human files.

The build is reproducible: the same tree gives the same bytes. If `bpy` is installed, Blender's own extension tool
validates the zip.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

from build_manual import ManualError, manual

ROOT = Path(__file__).resolve().parent
ADDON = ROOT / "blender_primdiffusion"
BACKEND = ROOT / "backend" / "primdiffusion"
FIXED_TIME = (1980, 1, 1, 0, 0, 0)
LEFT_OUT_SUFFIXES = {".pyc", ".nbi", ".nbc", ".part"}
STORED_SUFFIXES = {".safetensors", ".npz"}
"""Compressed already, or not compressible: stored without compression, for a fast build and a fast install."""


VIEWER = {
    "id": "primdiffusion_viewer",
    "name": "PrimDiffusion Viewer",
    "tagline": "Pose, animate, reshape and render generated 3D humans",
}
"""Entries of the viewer's manifest that differ."""
VIEWER_LACKS = ("backend/setup.py", "backend/packages.py", "requirements/", "ui/setup.py", "bundled/")
"""What downloads or is downloaded for: files and folders that the viewer does not have."""
VIEWER_BUNDLES = tuple(f"bundled/primdiffusion/{part}/" for part in ("files", "formats", "body/data"))
"""Parts of the backend that the viewer does have."""
LARGEST_IN_GALLERY = 3_000_000
"""Bytes of a .human file; compact ones have 2.1 MB."""


class BuildError(RuntimeError):
    """The zip cannot be built or is not valid; the message says why."""


def contents(addon: Path = ADDON, backend: Path = BACKEND) -> dict[str, Path]:
    """Files by their name in the zip, sorted: the add-on at the top, the backend under bundled/primdiffusion.

    The manual's pages are not included, because they are not files; `build` adds them.
    """
    files = {"LICENSE": ROOT / "LICENSE"}
    for root, prefix in ((addon, ""), (backend, "bundled/primdiffusion/")):
        for path in root.rglob("*"):
            inside = path.relative_to(root)
            hidden = any(part == "__pycache__" or part.startswith(".") for part in inside.parts)
            if path.is_file() and not hidden and path.suffix not in LEFT_OUT_SUFFIXES:
                files[prefix + inside.as_posix()] = path
    return dict(sorted(files.items()))


def viewer_contents(gallery: Path | None = None) -> dict[str, Path]:
    """As `contents`, of the viewer with the .human files in the folder `gallery`. Raises BuildError for a large one."""
    files = {
        name: path
        for name, path in contents().items()
        if name.startswith(VIEWER_BUNDLES) or not name.startswith(VIEWER_LACKS)
    }
    humans = [] if gallery is None else sorted(gallery.glob("*.human"))
    if gallery is not None and not humans:
        raise BuildError(f"there are no .human files in {gallery}: make some with scripts/make_gallery.py")
    for path in humans:
        if path.stat().st_size > LARGEST_IN_GALLERY:
            limit = f"{LARGEST_IN_GALLERY / 1e6:.0f} MB"
            raise BuildError(f"{path} is larger than {limit}: generate it with scripts/make_gallery.py")
        files[f"gallery/{path.name}"] = path
    return dict(sorted(files.items()))


def viewer_manifest(manifest: str) -> str:
    """The viewer's manifest, from the other one: other names, and no permission to use the network."""
    lines = []
    for line in manifest.splitlines(keepends=True):
        key = line.partition(" = ")[0]
        if key in VIEWER:
            line = f'{key} = "{VIEWER[key]}"\n'
        if key == "files":
            line = 'files = "Write temporary volumes, run a generator you installed"\n'
        if key != "network":
            lines.append(line)
    return "".join(lines)


def build(out: Path, *, viewer: bool = False, gallery: Path | None = None) -> Path:
    """Write `primdiffusion-<version>.zip`, or that of the viewer, into `out` and return its path.

    Raises BuildError when a part is missing, and as `viewer_contents`.
    """
    text = (ADDON / "blender_manifest.toml").read_text(encoding="utf-8")
    text = viewer_manifest(text) if viewer else text
    manifest = tomllib.loads(text)
    files = viewer_contents(gallery) if viewer else contents()
    if not viewer and "bundled/primdiffusion/__init__.py" not in files:
        raise BuildError(f"the backend was not found in {BACKEND}: build from a complete checkout")
    try:
        pages = {f"manual/{name}": page for name, page in manual().items()}
    except ManualError as error:
        raise BuildError(str(error)) from error
    pages["blender_manifest.toml"] = text.encode()
    out.mkdir(parents=True, exist_ok=True)
    target = out / f"{manifest['id']}-{manifest['version']}.zip"
    unfinished = target.with_suffix(".zip.part")
    with zipfile.ZipFile(unfinished, "w") as archive:
        for name in sorted({*files, *pages}):
            entry = zipfile.ZipInfo(name, FIXED_TIME)
            entry.external_attr = 0o644 << 16
            stored = Path(name).suffix in STORED_SUFFIXES
            entry.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
            archive.writestr(entry, pages[name] if name in pages else files[name].read_bytes())
    os.replace(unfinished, target)
    return target


def blender_extension_tool() -> Path | None:
    """The path of Blender's command line tool for extensions in the installed `bpy`; None without `bpy`."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        return None
    return next(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"), None)


def validate(archive: Path, tool: Path) -> None:
    """Raises BuildError with the tool's output if `blender --command extension validate` would reject the zip.

    As there, tags must be in Blender's list, which is that of extensions.blender.org.
    """
    tags = tool.parents[3] / "modules" / "_bpy_internal" / "extensions" / "tags.py"
    command = [sys.executable, str(tool), "validate", "--valid-tags", str(tags), str(archive)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, encoding="utf-8")
    if done.returncode != 0:
        raise BuildError(f"Blender's extension tool rejects {archive.name}: {(done.stdout + done.stderr).strip()}")


def write_index(folder: Path, tool: Path) -> Path:
    """Write index.json for the zips in `folder`, which makes it an extension repository; returns its path.

    `blender --command extension server-generate` does the same. Raises BuildError with the tool's output.
    """
    command = [sys.executable, str(tool), "server-generate", "--repo-dir", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, encoding="utf-8")
    if done.returncode != 0:
        raise BuildError(f"no index was written for {folder}: {(done.stdout + done.stderr).strip()}")
    return folder / "index.json"


def main() -> None:
    """Build the zip, validate it and print its size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the zip")
    parser.add_argument("--index", action="store_true", help="also index.json: the folder is then a repository")
    parser.add_argument("--viewer", action="store_true", help="the extension without set-up, backend and checkpoints")
    parser.add_argument("--gallery", type=Path, help="folder of .human files that the viewer brings")
    arguments = parser.parse_args()
    if arguments.gallery is not None and not arguments.viewer:
        parser.error("--gallery goes with --viewer")
    archive = build(arguments.out, viewer=arguments.viewer, gallery=arguments.gallery)
    with zipfile.ZipFile(archive) as made:
        count = len(made.namelist())
    tool = blender_extension_tool()
    if arguments.index and tool is None:
        parser.error(
            "--index needs Blender's extension tool: pip install bpy, or run `blender --command extension "
            f"server-generate --repo-dir {arguments.out}`"
        )
    if tool is not None:
        validate(archive, tool)
        if arguments.index:
            print(write_index(arguments.out, tool))
    checked = "valid" if tool is not None else "not validated: bpy is not installed"
    print(f"{archive} ({archive.stat().st_size / 1e6:.1f} MB, {count} files, {checked})")


if __name__ == "__main__":
    main()
