// Writes pcl_{spfh,fpfh,pfh}.txt: PCL's features of cloud.txt; neighbours within 0.5, for PFH the 24 nearest.

#include <fstream>
#include <numeric>

#include <pcl/features/fpfh.h>
#include <pcl/features/pfh.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>

using Cloud = pcl::PointCloud<pcl::PointNormal>;

template <typename Values> void write_row(std::ofstream &out, const Values &values, int size) {
    for (int i = 0; i < size; ++i) out << values[i] << (i + 1 < size ? ' ' : '\n');
}

int main() {
    Cloud::Ptr cloud(new Cloud);
    std::ifstream in("cloud.txt");
    for (pcl::PointNormal p; in >> p.x >> p.y >> p.z >> p.normal_x >> p.normal_y >> p.normal_z;) cloud->push_back(p);
    pcl::search::KdTree<pcl::PointNormal>::Ptr tree(new pcl::search::KdTree<pcl::PointNormal>);
    tree->setInputCloud(cloud);

    pcl::FPFHEstimation<pcl::PointNormal, pcl::PointNormal, pcl::FPFHSignature33> fpfh;
    fpfh.setInputCloud(cloud);
    fpfh.setInputNormals(cloud);
    fpfh.setSearchMethod(tree);
    fpfh.setRadiusSearch(0.5);
    pcl::PointCloud<pcl::FPFHSignature33> fpfh_rows;
    fpfh.compute(fpfh_rows);
    std::ofstream fpfh_out("pcl_fpfh.txt"), spfh_out("pcl_spfh.txt"), pfh_out("pcl_pfh.txt");
    for (const auto &row : fpfh_rows) write_row(fpfh_out, row.histogram, 33);

    for (std::size_t i = 0; i < cloud->size(); ++i) {
        pcl::Indices indices;
        std::vector<float> distances_sq;
        tree->radiusSearch(*cloud, i, 0.5, indices, distances_sq);
        Eigen::MatrixXf f1 = Eigen::MatrixXf::Zero(1, 11), f2 = f1, f3 = f1;
        fpfh.computePointSPFHSignature(*cloud, *cloud, i, 0, indices, f1, f2, f3);
        Eigen::VectorXf row(33);
        row << f1.row(0).transpose(), f2.row(0).transpose(), f3.row(0).transpose();
        write_row(spfh_out, row, 33);
    }

    pcl::PFHEstimation<pcl::PointNormal, pcl::PointNormal, pcl::PFHSignature125> pfh;
    pfh.setInputCloud(cloud);
    pfh.setInputNormals(cloud);
    pfh.setSearchMethod(tree);
    pfh.setKSearch(24);
    pcl::PointCloud<pcl::PFHSignature125> pfh_rows;
    pfh.compute(pfh_rows);
    for (const auto &row : pfh_rows) write_row(pfh_out, row.histogram, 125);
}
