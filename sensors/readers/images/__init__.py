"""Readers of image sequences: TUM RGB-D, EuRoC ASL, KITTI odometry, 7-Scenes, folders, photos, videos, ROS bags."""
