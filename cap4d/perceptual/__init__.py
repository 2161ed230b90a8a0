"""Networks trained on photographs, which judge how alike two pictures look; the weights come from the user."""
