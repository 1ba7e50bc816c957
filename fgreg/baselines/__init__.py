"""What fgreg is compared with: the published alternating method, and registration by points seen in both frames."""
