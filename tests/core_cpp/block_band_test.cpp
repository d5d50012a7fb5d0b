#include "poses/block_band.hpp"

#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "helpers.hpp"

using radarsdf::BlockBand;
using radarsdf::kBlock;
using radarsdf::kPose;

namespace {

constexpr std::int64_t kRows = 9;

// B B^T of a random lower band matrix B, as a band and as a dense matrix. The product has the bandwidth of B.
struct Random {
  BlockBand band;
  std::vector<double> whole;  // (6 kRows, 6 kRows)

  explicit Random(std::int64_t width) : band(kRows, width), whole(kPose * kRows * kPose * kRows) {
    const std::vector<double> numbers = test::normal_numbers<double>(kPose * kRows * kPose * kRows, 1, 3);
    constexpr std::int64_t size = kPose * kRows;
    std::vector<double> b(size * size);
    for (std::int64_t i = 0; i < size; ++i) {
      for (std::int64_t j = 0; j <= i; ++j) {
        if (i / kPose - j / kPose <= width) b[size * i + j] = numbers[size * i + j] + (i == j ? 5 : 0);
      }
    }
    for (std::int64_t i = 0; i < size; ++i) {
      for (std::int64_t j = 0; j < size; ++j) {
        for (std::int64_t k = 0; k < size; ++k) whole[size * i + j] += b[size * i + k] * b[size * j + k];
        const std::int64_t row = i / kPose, column = j / kPose;
        if (column <= row && row - column <= width) {
          band.block(row, column)[kPose * (i % kPose) + j % kPose] = whole[size * i + j];
        }
      }
    }
  }
};

}  // namespace

TEST_CASE("the band factor solves the dense system") {
  for (const std::int64_t width : {0, 1, 3, 20}) {
    Random random(width);
    REQUIRE(random.band.factor());
    const std::vector<double> wanted = test::normal_numbers<double>(kPose * kRows, 1, 5);
    std::vector<double> x(wanted.size());
    for (std::size_t i = 0; i < x.size(); ++i) {
      for (std::size_t j = 0; j < x.size(); ++j) x[i] += random.whole[x.size() * i + j] * wanted[j];
    }
    random.band.solve(x.data());
    for (std::size_t i = 0; i < x.size(); ++i) CHECK(x[i] == doctest::Approx(wanted[i]).epsilon(1e-9));
  }
}

TEST_CASE("blocks of the inverse equal those of the dense inverse") {
  for (const std::int64_t width : {0, 2, 20}) {
    Random random(width);
    REQUIRE(random.band.factor());
    const BlockBand inverse = random.band.inverse();
    constexpr std::int64_t size = kPose * kRows;
    for (std::int64_t column = 0; column < size; ++column) {
      std::vector<double> unit(size);
      unit[static_cast<std::size_t>(column)] = 1;
      random.band.solve(unit.data());
      const std::int64_t j = column / kPose;
      for (std::int64_t i = j; i < kRows && i <= j + random.band.width(); ++i) {
        for (int a = 0; a < kPose; ++a) {
          CHECK(inverse.block(i, j)[kPose * a + column % kPose] ==
                doctest::Approx(unit[static_cast<std::size_t>(kPose * i + a)]).epsilon(1e-9));
        }
      }
    }
  }
}

TEST_CASE("a matrix that is not positive definite is rejected") {
  BlockBand band(2, 1);
  for (int a = 0; a < kPose; ++a) band.block(0, 0)[kPose * a + a] = band.block(1, 1)[kPose * a + a] = 1;
  band.block(1, 0)[0] = 1;
  CHECK_FALSE(band.factor());
}
