"""Every file of the MCAP project's conformance suite is healthy, read, recovered without loss, never a traceback."""

from collections import Counter
from pathlib import Path

import pytest
from mcap.records import Message
from mcap.stream_reader import StreamReader

from rtctl import cli
from rtctl.errors import EXIT_FAILED, EXIT_OK
from rtctl.log import read, read_run
from rtctl.log.read.examine import examine
from rtctl.log.read.info import info
from rtctl.log.read.mend import LOSSLESS, mend
from tests.mcap_conformance import CONTENTS, Content, suite

COUNTS = {
    "NoData": 6,
    "OneMessage": 154,
    "OneSchemalessMessage": 74,
    "TenMessages": 154,
    "OneAttachment": 14,
    "OneMetadata": 14,
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Content]]:
    folder = tmp_path_factory.mktemp("conformance")
    found = []
    for name, content, data in suite():
        (folder / name).write_bytes(data)
        found.append((folder / name, content))
    return found


def test_the_suite_is_the_published_one(files: list[tuple[Path, Content]]):
    assert len(files) == 416
    assert Counter(content.name for _, content in files) == COUNTS
    names = {path.name for path, _ in files}
    assert {"TenMessages-ch-chx-mx-pad-rch-rsh-st-sum.mcap", "OneAttachment-ax-pad-st-sum.mcap"} <= names


def test_another_reader_finds_the_files_valid(files: list[tuple[Path, Content]]):
    for path, content in files:
        with path.open("rb") as file:  # walking: its seeking reader wants channels in the summary
            found = [r for r in StreamReader(file, validate_crcs=True).records if isinstance(r, Message)]
        assert [(m.sequence, m.log_time, m.publish_time) for m in found] == list(content.messages), path.name


def test_each_is_read_healthy_and_recovered_without_loss(files: list[tuple[Path, Content]], tmp_path: Path):
    for k, (path, content) in enumerate(files):
        count = len(content.messages)
        found = info(path)
        assert sum(t["messages"] for t in found["topics"].values()) == count, path.name
        assert [f for f in examine(path) if not f.good] == [], path.name
        log = read(path)
        if count:
            topic = log["example"]
            assert sorted(topic.time.tolist()) == sorted(t for _, t, _ in content.messages), path.name
            assert topic.payloads == [b"\1\2\3"] * count
        assert len(log.attachments) == content.attachment
        done = mend(path, tmp_path / f"{k}.mcap")
        assert (done.code, done.messages, done.independent) == (LOSSLESS, count, count), path.name
        again = read(done.path)
        assert again.complete
        assert {n: len(again[n]) for n in again.topics} == ({"example": count} if content.channel else {})
        assert again.attachments == log.attachments
        assert again.metadata.get("myMetadata") == log.metadata.get("myMetadata")
        assert ("myMetadata" in again.metadata) == content.metadata
        assert read_run(path).count("example") == count


@pytest.mark.parametrize("content", CONTENTS, ids=lambda content: content.name)
def test_no_command_gives_a_traceback(
    files: list[tuple[Path, Content]],
    content: Content,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    parser = cli.build_parser()
    monkeypatch.setattr(cli, "build_parser", lambda: parser)  # made once: it takes longer than the commands do here
    for path, of in files:
        if of != content:
            continue
        out = str(tmp_path / "out")
        for arguments in (
            ["info"],
            ["info", "--json"],
            ["doctor"],
            ["can"],
            ["mavlink"],
            ["tail", "--for", "0.01"],
            ["replay"],
            ["export", "--topic", "example", "--out", f"{out}.csv"],
            ["export", "--out", f"{out}.tlog"],
            ["export", "--topic", "example", "--out", f"{out}.parquet"],
            ["export", "--out", f"{out}.log"],
            ["plot", "--list"],
            ["plot", "--out", f"{out}.png"],
            ["report", "--out", f"{out}.html"],
            ["recover", "--out", f"{out}.mcap"],
        ):
            code = cli.main(["log", arguments[0], str(path), *arguments[1:]])
            said = capsys.readouterr()
            assert code in (EXIT_OK, EXIT_FAILED), (path.name, arguments)
            assert said.err.count("\n") == code, (path.name, arguments, said)  # a refusal is one line
        (tmp_path / "out.mcap").unlink()
        assert cli.main(["log", "diff", str(path), str(path)]) == EXIT_FAILED
        capsys.readouterr()
