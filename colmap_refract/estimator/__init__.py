"""The estimator: optics of plane layers, points eliminated in compiled code, poses and planes solved by Ceres."""
