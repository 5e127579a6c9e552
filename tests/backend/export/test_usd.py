"""The .usdz of a mesh proxy: an archive that USD accepts; what Blender makes of it is tested in tests/blender."""

import io
import zipfile

import numpy as np
import pytest
from export_people import proxy
from PIL import Image
from primdiffusion.export.usd import ALIGNMENT, LOCAL_HEADER, STAGE, TEXTURE, write_proxy_usdz


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    path = tmp_path_factory.mktemp("usd") / "person.usdz"
    write_proxy_usdz(path, proxy(), {"seed": 7, "name": 'A "quoted" name'})
    return path


def test_it_is_stored_uncompressed_with_the_stage_first_and_files_on_64_bytes(archive):
    with zipfile.ZipFile(archive) as opened:
        entries = opened.infolist()
        assert [entry.filename for entry in entries] == [STAGE, TEXTURE]
        assert not opened.testzip()
    content = archive.read_bytes()
    for entry in entries:
        header = content[entry.header_offset : entry.header_offset + LOCAL_HEADER]
        lengths = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
        assert entry.compress_type == zipfile.ZIP_STORED
        assert (entry.header_offset + LOCAL_HEADER + lengths) % ALIGNMENT == 0


def test_the_texture_is_the_proxys(archive):
    with zipfile.ZipFile(archive) as opened:
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(opened.read(TEXTURE)))), proxy().texture)


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "person.usdz").mkdir()
    with pytest.raises(OSError):
        write_proxy_usdz(tmp_path / "person.usdz", proxy(), {})
    assert [path.name for path in tmp_path.iterdir()] == ["person.usdz"]
