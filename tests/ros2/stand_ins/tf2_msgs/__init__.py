"""A stand-in for the package ``tf2_msgs``, of which there are no wheels."""
