"""The networks of the PWVO paper: its rows, their inputs in units or without, their losses."""
