"""Measured and made here: charts, training, sample shots; nothing above imports it."""
