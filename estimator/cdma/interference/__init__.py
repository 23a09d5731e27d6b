"""Light that carries no code of ours and is no mains flicker: PWM-dimmed lamps."""
