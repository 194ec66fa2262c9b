"""Bodies simulated by others than the built-in world: MuJoCo and Gazebo."""
