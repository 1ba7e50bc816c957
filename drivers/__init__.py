"""Devices: one file each, imported when used."""
