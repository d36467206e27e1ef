"""Cut user names, passwords and keys from URLs."""

from __future__ import annotations

import re

SPACES = re.compile(r"(\s+)")
# Matches the user name and the password of a URL. A password may contain unescaped slashes.
CREDENTIALS = re.compile(r"(?<!\w)(\w+)://(?:([^/\s]*)|[^/\s@:]+:(?!\d+/)\S*)@")
CONTAINERS = ("abfs", "abfss", "wasb", "wasbs")  # schemes of URLs that have CONTAINER@ACCOUNT
# Matches the parameters of a URL that are keys, tokens or signatures.
SECRET_PARAMETERS = re.compile(
    r"([?&](?=[^?&=\s]*(?:key|secret|token|sig|password|credential))[^?&=\s]*=)[^&\s]+",
    re.IGNORECASE,
)


def without_secrets(text: str) -> str:
    """Return a text without the user names, passwords and keys of the URLs in it.

    Every URL passes through here before it is shown or stored. The time is proportional to the
    length of the text, whatever the text is.
    """
    if "://" not in text:
        return text
    return "".join(map(_without_secrets_in_word, SPACES.split(text)))


def _without_secrets_in_word(word: str) -> str:
    # Before the last @, each search for an @ succeeds. After it, each search would read all the
    # rest.
    credentials, at, rest = word.rpartition("@")
    open_word = CREDENTIALS.sub(_without_credentials, credentials + at) + rest
    return SECRET_PARAMETERS.sub(r"\1...", open_word)


def _without_credentials(match: re.Match[str]) -> str:
    scheme, user = match.groups()
    is_container = scheme in CONTAINERS and user is not None and ":" not in user
    return match[0] if is_container else f"{scheme}://"
