"""Forward model: sessions with known truth, camera images and channel data. Shares no code with the estimator.

``simulate(PRESETS["paper"], seed)`` gives a session in memory, ``write_session`` puts it in a folder.
"""
