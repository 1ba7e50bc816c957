"""What drivers are tested with, ours and those of other packages."""
