"""Images and volumes before their motion is known."""
