"""Files of poses and motion in every form that people have, as motion of SMPL's skeleton."""
