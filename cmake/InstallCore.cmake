# Installs the core for other CMake projects: find_package(radarsdf_core), then link radarsdf::core.
include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

set(package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/radarsdf_core)
install(
  TARGETS radarsdf_core
  EXPORT radarsdf_core_targets
  ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT core)
install(
  EXPORT radarsdf_core_targets
  FILE radarsdf_coreTargets.cmake
  NAMESPACE radarsdf::
  DESTINATION ${package_dir}
  COMPONENT core)
# Not the headers that only a copy of the kernels can include, nor those of Python.
install(
  DIRECTORY ${PROJECT_SOURCE_DIR}/csrc/
  DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/radarsdf
  COMPONENT core
  FILES_MATCHING
  PATTERN "*.hpp"
  PATTERN "vector.hpp" EXCLUDE
  PATTERN "feature_vector.hpp" EXCLUDE
  PATTERN "bindings" EXCLUDE)

configure_package_config_file(${PROJECT_SOURCE_DIR}/cmake/radarsdf_coreConfig.cmake.in
                              ${PROJECT_BINARY_DIR}/radarsdf_coreConfig.cmake INSTALL_DESTINATION ${package_dir})
write_basic_package_version_file(${PROJECT_BINARY_DIR}/radarsdf_coreConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(
  FILES ${PROJECT_BINARY_DIR}/radarsdf_coreConfig.cmake ${PROJECT_BINARY_DIR}/radarsdf_coreConfigVersion.cmake
  DESTINATION ${package_dir}
  COMPONENT core)
