"""The figures of E. Eade and T. Drummond, "Scalable monocular SLAM" (2006), made again on rendered sequences."""
