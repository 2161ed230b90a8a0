"""Networks trained on photographs that judge how alike two pictures look; weights come from the user."""
