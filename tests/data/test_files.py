"""Files and folders appear whole: after a failure the old one is still there, and nothing else."""

from pathlib import Path

import pytest

from data.files import file_hash, new_folder, write_text


def test_hash_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert file_hash(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_text_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "note.txt"
    write_text(path, "one")
    write_text(path, "zwölf\n")
    assert path.read_text(encoding="utf-8") == "zwölf\n"
    assert [file.name for file in tmp_path.iterdir()] == ["note.txt"]


def test_text_that_cannot_be_encoded_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "note.txt"
    write_text(path, "one")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "\ud800")
    assert path.read_text() == "one"
    assert [file.name for file in tmp_path.iterdir()] == ["note.txt"]


def test_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    for name in ("first", "second"):
        with new_folder(tmp_path / "model") as work:
            (work / name).write_text(name)
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["model", "model/second"]


def test_folder_stays_when_writing_fails(tmp_path: Path) -> None:
    with new_folder(tmp_path / "model") as work:
        (work / "first").write_text("")
    with pytest.raises(UnicodeEncodeError), new_folder(tmp_path / "model") as work:
        (work / "second").write_text("\ud800", encoding="utf-8")
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["model", "model/first"]


def test_leftovers_of_a_kill_are_not_mixed_in(tmp_path: Path) -> None:
    for ending in (".tmp", ".old"):
        (tmp_path / f"model{ending}").mkdir()
        (tmp_path / f"model{ending}" / "stray").write_text("")
    with new_folder(tmp_path / "model") as work:
        (work / "first").write_text("")
    assert [path.name for path in (tmp_path / "model").iterdir()] == ["first"]


def test_files_of_a_new_folder_have_its_rights(tmp_path: Path) -> None:
    with new_folder(tmp_path / "model") as work:
        (work / "part").mkdir()
        (work / "part/weights").write_text("w")
        (work / "part/weights").chmod(0o600)
    folder = tmp_path / "model"
    assert (folder / "part/weights").stat().st_mode & 0o777 == folder.stat().st_mode & 0o666
