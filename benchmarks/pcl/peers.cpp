// Times what PCL and FLANN offer, in one thread. Arrays come as raw float32 files; each line of output is one run:
// name, points described or queried, seconds of processor time, seconds by the clock.
//
//   peers describe CLOUD RADIUS MIN_RADIUS LRF_RADIUS REPEATS NAME:POINTS...   CLOUD: rows of x y z nx ny nz
//   peers tree TARGET SOURCE DIMENSIONS REPEATS QUERIES

#include <pcl/common/io.h>
#include <pcl/features/fpfh.h>
#include <pcl/features/pfh.h>
#include <pcl/features/rops_estimation.h>
#include <pcl/features/shot.h>
#include <pcl/features/spin_image.h>
#include <pcl/features/usc.h>
#include <pcl/search/kdtree.h>
#include <pcl/surface/gp3.h>

#include <flann/flann.hpp>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <numeric>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

using Points = pcl::PointCloud<pcl::PointXYZ>;
using Normals = pcl::PointCloud<pcl::Normal>;
using Tree = pcl::search::KdTree<pcl::PointXYZ>;

struct Scan {
    Points::Ptr points{new Points};
    Normals::Ptr normals{new Normals};
    Tree::Ptr tree{new Tree};
    double radius, min_radius, lrf_radius;
};

std::vector<float> read(const std::string& path) {
    std::ifstream file(path, std::ios::binary | std::ios::ate);
    if (!file) throw std::runtime_error("cannot read " + path);
    std::vector<float> values(static_cast<size_t>(file.tellg()) / sizeof(float));
    file.seekg(0);
    file.read(reinterpret_cast<char*>(values.data()), values.size() * sizeof(float));
    return values;
}

void report(const std::string& name, size_t count, const std::function<void()>& work) {
    const auto start = std::chrono::steady_clock::now();
    const std::clock_t cpu = std::clock();
    work();
    const double cpu_s = double(std::clock() - cpu) / CLOCKS_PER_SEC;
    const std::chrono::duration<double> wall = std::chrono::steady_clock::now() - start;
    std::printf("%s %zu %.6f %.6f\n", name.c_str(), count, cpu_s, wall.count());
    std::fflush(stdout);
}

template <typename Estimator>
void prepare(Estimator& estimator, const Scan& scan, const pcl::IndicesPtr& rows) {
    estimator.setInputCloud(scan.points);
    estimator.setIndices(rows);
    estimator.setSearchMethod(scan.tree);
    estimator.setRadiusSearch(scan.radius);
}

void search(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::Indices found;
    std::vector<float> sq_distances;
    for (const auto row : *rows) scan.tree->radiusSearch(row, scan.radius, found, sq_distances);
}

void spin_images(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::SpinImageEstimation<pcl::PointXYZ, pcl::Normal, pcl::Histogram<153>> estimator(8, 0.0, 0);
    prepare(estimator, scan, rows);
    estimator.setInputNormals(scan.normals);
    pcl::PointCloud<pcl::Histogram<153>> result;
    estimator.compute(result);
}

void shot(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::SHOTEstimation<pcl::PointXYZ, pcl::Normal, pcl::SHOT352> estimator;
    prepare(estimator, scan, rows);
    estimator.setInputNormals(scan.normals);
    estimator.setLRFRadius(scan.lrf_radius);
    pcl::PointCloud<pcl::SHOT352> result;
    estimator.compute(result);
}

// PCL first computes the simplified histogram of every point that some row has as a neighbour: of few rows in a large
// support, of the whole cloud. Here only those of the rows are computed, so that time grows with their number as it
// does where all points are described. Both of its searches are made.
void fpfh(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::FPFHEstimation<pcl::PointXYZ, pcl::Normal, pcl::FPFHSignature33> estimator;
    prepare(estimator, scan, rows);
    Eigen::MatrixXf parts[3];
    for (auto& part : parts) part = Eigen::MatrixXf::Zero(scan.points->size(), 11);
    pcl::Indices found;
    std::vector<float> sq_distances;
    Eigen::VectorXf histogram(33);
    for (const auto row : *rows) {
        scan.tree->radiusSearch(row, scan.radius, found, sq_distances);
        estimator.computePointSPFHSignature(*scan.points, *scan.normals, row, row, found, parts[0], parts[1], parts[2]);
        scan.tree->radiusSearch(row, scan.radius, found, sq_distances);
        estimator.weightPointSPFHSignature(parts[0], parts[1], parts[2], found, sq_distances, histogram);
    }
}

void pfh(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::PFHEstimation<pcl::PointXYZ, pcl::Normal, pcl::PFHSignature125> estimator;
    prepare(estimator, scan, rows);
    estimator.setInputNormals(scan.normals);
    pcl::PointCloud<pcl::PFHSignature125> result;
    estimator.compute(result);
}

void usc(const Scan& scan, const pcl::IndicesPtr& rows) {
    pcl::UniqueShapeContext<pcl::PointXYZ, pcl::UniqueShapeContext1960, pcl::ReferenceFrame> estimator;
    prepare(estimator, scan, rows);
    estimator.setMinimalRadius(scan.min_radius);
    estimator.setPointDensityRadius(0.2 * scan.radius);
    estimator.setLocalRadius(scan.lrf_radius);
    pcl::PointCloud<pcl::UniqueShapeContext1960> result;
    estimator.compute(result);
}

std::vector<pcl::Vertices> triangulate(const Scan& scan) {
    pcl::PointCloud<pcl::PointNormal>::Ptr joined(new pcl::PointCloud<pcl::PointNormal>);
    pcl::concatenateFields(*scan.points, *scan.normals, *joined);
    pcl::GreedyProjectionTriangulation<pcl::PointNormal> greedy;
    greedy.setSearchRadius(2.5 * scan.lrf_radius);
    greedy.setMu(3.0);
    greedy.setMaximumNearestNeighbors(100);
    greedy.setMaximumSurfaceAngle(M_PI / 2);
    greedy.setMinimumAngle(M_PI / 36);
    greedy.setMaximumAngle(5 * M_PI / 6);
    greedy.setNormalConsistency(true);
    greedy.setInputCloud(joined);
    std::vector<pcl::Vertices> triangles;
    greedy.reconstruct(triangles);
    return triangles;
}

// The mesh that RoPS needs is made before; its time is not counted.
void rops(const Scan& scan, const pcl::IndicesPtr& rows, const std::vector<pcl::Vertices>& triangles) {
    pcl::ROPSEstimation<pcl::PointXYZ, pcl::Histogram<135>> estimator;
    prepare(estimator, scan, rows);
    estimator.setTriangles(triangles);
    estimator.setNumberOfPartitionBins(5);
    estimator.setNumberOfRotations(3);
    estimator.setSupportRadius(scan.radius);
    pcl::PointCloud<pcl::Histogram<135>> result;
    estimator.compute(result);
}

void describe(int argc, char** argv) {
    Scan scan;
    const auto values = read(argv[2]);
    scan.radius = std::stod(argv[3]);
    scan.min_radius = std::stod(argv[4]);
    scan.lrf_radius = std::stod(argv[5]);
    for (size_t i = 0; i + 5 < values.size(); i += 6) {
        scan.points->push_back({values[i], values[i + 1], values[i + 2]});
        scan.normals->push_back({values[i + 3], values[i + 4], values[i + 5]});
    }
    scan.tree->setInputCloud(scan.points);
    std::vector<pcl::Vertices> triangles;
    const std::map<std::string, std::function<void(const Scan&, const pcl::IndicesPtr&)>> works{
        {"search", search}, {"spin", spin_images}, {"shot", shot}, {"fpfh", fpfh}, {"pfh", pfh}, {"usc", usc},
        {"rops", [&](const Scan& s, const pcl::IndicesPtr& rows) { rops(s, rows, triangles); }},
    };
    pcl::Indices order(scan.points->size());
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), std::mt19937(0));
    for (int k = 7; k < argc; ++k) {
        const std::string item = argv[k];
        const auto colon = item.find(':');
        const std::string name = item.substr(0, colon);
        const size_t count = std::min<size_t>(std::stoul(item.substr(colon + 1)), order.size());
        if (name == "rops") triangles = triangulate(scan);
        const pcl::IndicesPtr rows(new pcl::Indices(order.begin(), order.begin() + count));
        for (int repeat = 0; repeat < std::stoi(argv[6]); ++repeat)
            report(name, count, [&] { works.at(name)(scan, rows); });
    }
}

void tree(char** argv) {
    auto target = read(argv[2]), source = read(argv[3]);
    const size_t dimensions = std::stoul(argv[4]), queries = std::stoul(argv[6]);
    const flann::Matrix<float> data(target.data(), target.size() / dimensions, dimensions);
    const flann::Matrix<float> wanted(source.data(), std::min(source.size() / dimensions, queries), dimensions);
    flann::Index<flann::L2<float>> index(data, flann::KDTreeSingleIndexParams(15));
    index.buildIndex();
    std::vector<int> rows(wanted.rows);
    std::vector<float> sq_distances(wanted.rows);
    flann::Matrix<int> found(rows.data(), wanted.rows, 1);
    flann::Matrix<float> sq(sq_distances.data(), wanted.rows, 1);
    for (int repeat = 0; repeat < std::stoi(argv[5]); ++repeat)
        report("tree", wanted.rows, [&] { index.knnSearch(wanted, found, sq, 1, flann::SearchParams(-1)); });
}

int main(int argc, char** argv) {
    try {
        const std::string what = argc > 1 ? argv[1] : "";
        if (what == "describe" && argc > 7) return describe(argc, argv), 0;
        if (what == "tree" && argc == 7) return tree(argv), 0;
        std::cerr << "usage: see the head of peers.cpp\n";
    } catch (const std::exception& error) {
        std::cerr << error.what() << "\n";
    }
    return 1;
}
