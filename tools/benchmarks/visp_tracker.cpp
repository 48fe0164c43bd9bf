// ViSP's model-based edge tracker on frames of a file, one at a time, for tools/bench latency.
//
//     visp_tracker MODEL.cao FRAMES COUNT WIDTH HEIGHT FX FY CX CY START
//
// FRAMES: COUNT grey images of 8 bits, one after the other, without a lens's distortion; START: the pose of the model in
// the camera frame at the first frame, 16 numbers row by row (m).  Each line of standard input is the number of a frame;
// it is answered by a line with the microseconds of track() and the position of the model's origin in the camera frame
// (m), or by "lost" with the microseconds.

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <vector>

#include <visp3/core/vpException.h>
#include <visp3/mbt/vpMbGenericTracker.h>

int main(int argc, char **argv)
{
  if (argc != 26) {
    std::cerr << "visp_tracker: " << argc - 1 << " arguments; 25" << std::endl;
    return 2;
  }
  const size_t count = std::strtoul(argv[3], nullptr, 10);
  const unsigned width = std::strtoul(argv[4], nullptr, 10), height = std::strtoul(argv[5], nullptr, 10);
  double number[20];
  for (int i = 0; i < 20; ++i) {
    number[i] = std::strtod(argv[6 + i], nullptr);
  }
  std::ifstream file(argv[2], std::ios::binary);
  std::vector<vpImage<unsigned char>> frames(count, vpImage<unsigned char>(height, width));
  for (auto &frame : frames) {
    file.read(reinterpret_cast<char *>(frame.bitmap), static_cast<std::streamsize>(width) * height);
  }
  if (!file) {
    std::cerr << "visp_tracker: " << argv[2] << " is too short" << std::endl;
    return 2;
  }

  // The settings of ViSP's tutorial "Markerless generic model-based tracking", but for its threshold's unit: the version
  // of Debian knows no other.
  vpMe edges;
  edges.setMaskSize(5);
  edges.setMaskNumber(180);
  edges.setRange(8);
  edges.setThreshold(10000);
  edges.setMu1(0.5);
  edges.setMu2(0.5);
  edges.setSampleStep(4);
  vpMbGenericTracker tracker(1, vpMbGenericTracker::EDGE_TRACKER);
  tracker.setMovingEdge(edges);
  tracker.setCameraParameters(vpCameraParameters(number[0], number[1], number[2], number[3]));
  tracker.setAngleAppear(vpMath::rad(70));
  tracker.setAngleDisappear(vpMath::rad(80));
  tracker.setNearClippingDistance(0.01);
  tracker.setFarClippingDistance(1.0);
  tracker.setClipping(tracker.getClipping() | vpMbtPolygon::FOV_CLIPPING);
  vpHomogeneousMatrix pose;
  for (unsigned i = 0; i < 16; ++i) {
    pose[i / 4][i % 4] = number[4 + i];
  }
  std::cout.setstate(std::ios::failbit); // it prints what it has read
  tracker.loadModel(argv[1]);
  std::cout.clear();
  tracker.initFromPose(frames[0], pose);
  std::cout << "ready" << std::endl;

  size_t place;
  while (std::cin >> place && place < count) {
    const auto start = std::chrono::steady_clock::now();
    bool lost = false;
    try {
      tracker.track(frames[place]);
      tracker.getPose(pose);
    } catch (const vpException &) {
      lost = true;
    }
    const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - start;
    if (lost) {
      std::printf("lost %.3f\n", took.count());
      tracker.initFromPose(frames[place], pose);
    } else {
      std::printf("%.3f %.9f %.9f %.9f\n", took.count(), pose[0][3], pose[1][3], pose[2][3]);
    }
    std::fflush(stdout);
  }
  return 0;
}
