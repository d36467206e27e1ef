"""Messages: no URL in them says more than where something is."""

from __future__ import annotations

import time

import pytest

from amvnet.cli.console import report, report_fault
from amvnet.errors import without_secrets

SECRETS = {
    "s3://KEY:SECRET@bucket/a.bin": "s3://bucket/a.bin",
    "s3://KEY:SEC%2FRET@bucket/a@b.bin": "s3://bucket/a@b.bin",
    "s3://KEY:SEC/RET@bucket/a.bin": "s3://bucket/a.bin",  # a password that is not escaped
    "s3://KEY:SEC@RET@bucket": "s3://bucket",
    "s3://KEY@bucket/a.bin": "s3://bucket/a.bin",
    "ray://KEY:SECRET@host:10001": "ray://host:10001",
    "https://host/a.bin?X-Amz-Signature=SECRET&x=1": "https://host/a.bin?X-Amz-Signature=...&x=1",
    "https://host/a?sig=SECRET": "https://host/a?sig=...",
    "s3://bucket/a?access_key=KEY&secret_key=SECRET": (
        "s3://bucket/a?access_key=...&secret_key=..."
    ),
    "abfs://KEY:SECRET@host/a": "abfs://host/a",
    "x: s3://KEY:SECRET@a/b: found y; s3://KEY:SECRET@c": "x: s3://a/b: found y; s3://c",
}
HARMLESS = (
    "s3://bucket/day@1/a:b.bin",
    "http://host:8080/a@b.bin",
    "abfss://container@account.dfs.core.windows.net/a.bin",
    "s3://bucket/a.bin?version=3",
    "me@example.org: expected a path, found a:b@c",
    "simulated-hdl64e:/data@home",
)


def test_user_names_passwords_and_keys_are_cut_from_urls() -> None:
    for text, expected in SECRETS.items():
        assert without_secrets(text) == expected
        assert "KEY" not in expected
        assert "SECRET" not in expected


def test_all_else_stays() -> None:
    for text in (*HARMLESS, *SECRETS.values()):
        assert without_secrets(text) == text


LONG = (
    "s3://" + "k" * 100_000,
    "a://b:" * 16_000,
    "@" + "a://b:" * 16_000,
    "a://b:1/" * 12_000 + "@",
    "s3://a?" + "key" * 33_000,
    "s3://a" + "?key" * 25_000,
)


@pytest.mark.parametrize("text", LONG, ids=range(len(LONG)))
def test_a_long_text_takes_little_time(text: str) -> None:
    start = time.process_time()
    without_secrets(text)
    assert time.process_time() - start < 2  # seconds; it was a minute


def test_nothing_that_is_printed_has_secrets(capsys: pytest.CaptureFixture[str]) -> None:
    for text in SECRETS:
        report(f"found {text}")
        report_fault(f"found {text}")
    printed = "".join(capsys.readouterr())
    for secret in ("KEY", "SECRET", "SEC/RET", "SEC%2FRET", "SEC@RET"):
        assert secret not in printed
