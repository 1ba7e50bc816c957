"""A session as it is conducted: devices to events, estimates to prompts and to where the stage turns."""
