"""Numbers and words that no file and no option should have."""

from __future__ import annotations

NUMBERS = (
    *("nan", "inf", "-inf", "-1", "0", "1e30", "-1e30", "1e-300", "1e400", "-0.5", "x", ""),
    *(str(2**31), str(2**63), str(2**70), str(10**9), str(10**12), "9" * 400, "9" * 5000),
)
WORDS = ("", "x", "None", "true", "-", "../..", "\ud7ff", "a" * 5000, "nan", "%s", "{}", '"')
