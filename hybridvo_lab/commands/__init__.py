"""Commands of the laboratory, which ``hybridvo`` offers where it is installed."""
