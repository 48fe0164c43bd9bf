"""Cameras as other programs write them."""

from __future__ import annotations

KALIBR = """%YAML:1.0

cam0:
  T_imu_cam: #rotation from camera to IMU R_CtoI, position of camera in IMU p_CinI
    - [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975]
    - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_imu_cam: !!opencv-matrix
    rows: 1
    cols: 1
    dt: d
    data:[1.]
  camera_model: pinhole
  distortion_coeffs: [-0.0135, 0.0020, -0.0117, 0.0025]
  distortion_model: equidistant
  intrinsics: [190.44, 190.44, 252.59, 254.94]
  resolution: [512, 512]
"""
STEREO = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3480e+02, 0., 3.3543e+02, 0., 5.3480e+02, 2.4094e+02, 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 14
   dt: d
   data: [ -2.7e-01, 7.0e-02, 1.7e-03, -2.8e-04, 1.0e-02, 0., 0., 0., 0., 0., 0., 0., 0., 0. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3280e+02, 0., 3.3443e+02, 0., 5.3280e+02, 2.4194e+02, 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 14
   dt: d
   data: [ -2.8e-01, 8.0e-02, 1.0e-03, 2.0e-04, 0., 0., 0., 0., 0., 0., 0., 0., 0., 0. ]
"""
ORB2 = """%YAML:1.0

#--- Camera Parameters, of the rectified images ---
Camera.fx: 435.2046959714599
Camera.fy: 435.2046959714599
Camera.cx: 367.4517211914062
Camera.cy: 252.2008514404297
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: 752
Camera.height: 480
LEFT.height: 480
LEFT.width: 752
LEFT.D: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data:[-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0]
LEFT.K: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0]
"""
ORB3 = """%YAML:1.0

File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.978477
Camera1.fy: 190.973307
Camera1.cx: 254.931706
Camera1.cy: 256.897442
Camera1.k1: 0.003482389402
Camera1.k2: 0.000715034845
Camera1.k3: -0.002053236141
Camera1.k4: 0.000202936736
Camera.width: 512
Camera.height: 512
IMU.T_b_c1: !!opencv-matrix
   rows: 2
   cols: 2
   dt: f
   data: [-0.9, 0.0,
         0.0, 1.0]
"""
VINS = """%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: fisheye
image_width: 640
image_height: 512
projection_parameters:
   k2: -0.0612
   k3: -0.0038
   k4: 0.0273
   k5: -0.0303
   mu: 413.326
   mv: 413.702
   u0: 305.951
   v0: 259.444
"""
OPENICC = {
    "final_reproj_error": 0.17, "fps": 60.0, "image_height": 1080, "image_width": 1920, "intrinsic_type": "FISHEYE",
    "intrinsics": {
        "aspect_ratio": 1.0026, "focal_length": 420.568, "principal_pt_x": 959.857, "principal_pt_y": 542.815,
        "radial_distortion_1": -0.0119, "radial_distortion_2": -0.0392, "radial_distortion_3": 0.0185,
        "radial_distortion_4": -0.005, "skew": 0.0,
    }, "nr_calib_images": 129, "stabelized": False,
}  # fmt: skip
OST = """# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo]

camera matrix
511.143797 0.000000 311.770522
0.000000 509.020589 247.452470
0.000000 0.000000 1.000000

distortion
0.198900 -0.317682 0.002252 -0.001667 0.000000

rectification
1.000000 0.000000 0.000000
0.000000 1.000000 0.000000
0.000000 0.000000 1.000000

projection
525.563232 0.000000 310.049056 0.000000
0.000000 524.047913 247.700893 0.000000
0.000000 0.000000 1.000000 0.000000
"""
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 4
1 SIMPLE_RADIAL 3072 2304 2559.81 1536 1152 -0.0205
2 OPENCV 1280 720 900.5 901.25 640.5 360.25 -0.1 0.05 0.001 -0.002
3 FULL_OPENCV 1280 720 1100.5 1101.25 640.5 360.25 0.31 -0.12 0.001 -0.002 0.01 0.52 0.03 0.001
4 OPENCV_FISHEYE 1280 720 500.5 501.25 640.5 360.25 0.01 -0.004 0.0015 -2e-05
5 RADIAL_FISHEYE 1280 720 500.5 640.5 360.25 0.01 -0.004
6 PINHOLE 1280 720 900.5 901.25 640.5 360.25
"""
REALSENSE = {
    "color": {"width": 848, "height": 480, "fx": 604.7, "fy": 604.5, "ppx": 421.9, "ppy": 246.6,
              "model": "distortion.brown_conrady", "coeffs": [-0.05, 0.06, 5e-4, -3e-4, -0.02]},
    "depth": {"width": 848, "height": 480, "fx": 422.0, "fy": 422.0, "ppx": 424.1, "ppy": 238.7,
              "model": "Kannala Brandt4", "coeffs": [-0.0022, 0.0376, -0.0364, 0.0059, 0.0]},
}  # fmt: skip
