"""Licences of assets: stated in headers, lists and materials."""

from scripts.asset_licences import licence_of


def test_licences_are_read_from_headers_lists_and_materials(tmp_path):
    (tmp_path / "pack/hat").mkdir(parents=True)
    root = tmp_path / "pack"
    (root / "hat/a.obj").write_text("# This asset was explicitly released as CC0 in september 2020.\nv 0 0 0\n")
    (root / "hat/b.mhclo").write_text("# license CC-BY-SA 4.0\n")
    (root / "hat/c.obj").write_text("v 0 0 0\n# CC0\n")
    (root / "hat/d.mhmat").write_text("# released as CC0\ndiffuseTexture d_diffuse.png\n")
    for name in ("d_diffuse.png", "e.png", "f.png"):
        (root / "hat" / name).write_bytes(b"")
    (tmp_path / "LICENSES.txt").write_text("Notes\npath | source | license\npack/hat/e.png | x | CC-BY-4.0 | y\n")
    found = {name: licence_of(root, f"hat/{name}") for name in ("a.obj", "b.mhclo", "d_diffuse.png", "e.png", "f.png")}
    assert found == {
        "a.obj": "CC0-1.0",
        "b.mhclo": "CC-BY-SA 4.0",
        "d_diffuse.png": "CC0-1.0",
        "e.png": "CC-BY-4.0",
        "f.png": "unknown",
    }
