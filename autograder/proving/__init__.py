"""Proof that the checks tell wrong from right: the kill matrix, the calibration of thresholds, and kept records of both."""
