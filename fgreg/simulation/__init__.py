"""Forward model: sessions with known truth, camera images and channel data. Shares no code with the estimator."""
