"""The commands of ``hybridvo``: what :mod:`hybridvo.cli` calls after parsing."""
