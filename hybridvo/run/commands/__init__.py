"""The commands of ``hybridvo``: what :mod:`hybridvo.run.cli` calls after parsing."""
