"""Readers of further published data sets, one file each, beside :mod:`hybridvo.data.datasets`."""
