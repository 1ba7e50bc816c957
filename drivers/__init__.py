"""Device drivers: one file each, imported when used."""
