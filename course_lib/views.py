"""Ways of looking at outputs where many are right: a random order, a sample, a trained model.

A view is a pure function (arguments, outputs) -> outputs. `arguments` are those of the call, as arrays and plain data, and `outputs` what
it returned, by path ("0", "1.entropy"). The view gives what all right answers have in common, such as sorted indices, frequencies or
truth values, and that is what is compared, shown and named. It runs where the comparison runs and never in the process of the
judged function, so it cannot be forged; it raises ValueError for outputs that it cannot read.
"""

from __future__ import annotations

READABLE = "result"
"""The kind of every observation that a view could read."""
