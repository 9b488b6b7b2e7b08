from pathlib import Path

from monstertruck_drivers.emulation import FileTree


def test_files_appear_change_and_go(tmp_path: Path):
    tree = FileTree(tmp_path)
    tree.put("a/b", "1")
    tree.put("a/c/d", "2\n")
    assert (tmp_path / "a/b").read_text() == "1\n"
    assert (tmp_path / "a/c/d").read_text() == "2\n"
    before = (tmp_path / "a/b").stat().st_ino
    tree.put("a/b", "1")
    assert (tmp_path / "a/b").stat().st_ino == before, "the same text is not written again"
    tree.put("a/b", "3")
    assert (tmp_path / "a/b").stat().st_ino != before, "a reader of the old file keeps it whole"
    tree.remove("a/c")
    tree.remove("a/missing")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]
    tree.put("a/c/d", "2\n")
    assert (tmp_path / "a/c/d").exists(), "what was removed is written anew"
    tree.remove("a/b")
    assert not (tmp_path / "a/b").exists()
