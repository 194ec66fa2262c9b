"""The page in the browser: a live team, or a recorded run."""
