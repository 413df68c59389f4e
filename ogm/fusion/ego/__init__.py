"""Motion of the ego vehicle: odometry from scans, smoothing of poses, de-skewing of scans."""
