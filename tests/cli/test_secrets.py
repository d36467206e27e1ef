"""Messages: no URL in them says more than where something is."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from amvnet.cli.console import report, report_fault
from amvnet.fleet.secrets import without_secrets

from fixtures.growth import takes_linear_time

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


# Texts by their length, for which a search may take quadratic time.
LONG: dict[str, Callable[[int], str]] = {
    "scheme": lambda length: "s3://" + "k" * length,
    "colons": lambda length: "a://b:" * (length // 6),
    "colons after @": lambda length: "@" + "a://b:" * (length // 6),
    "ports before @": lambda length: "a://b:1/" * (length // 8) + "@",
    "a key": lambda length: "s3://a?" + "key" * (length // 3),
    "keys": lambda length: "s3://a" + "?key" * (length // 4),
}


@pytest.mark.parametrize("name", LONG)
def test_the_time_is_proportional_to_the_length_of_a_text(name: str) -> None:
    texts = {length: LONG[name](length) for length in (25_000, 100_000)}
    takes_linear_time(lambda length: without_secrets(texts[length]), 25_000)


def test_nothing_that_is_printed_has_secrets(capsys: pytest.CaptureFixture[str]) -> None:
    for text in SECRETS:
        report(f"found {text}")
        report_fault(f"found {text}")
    printed = "".join(capsys.readouterr())
    for secret in ("KEY", "SECRET", "SEC/RET", "SEC%2FRET", "SEC@RET"):
        assert secret not in printed
